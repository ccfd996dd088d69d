"""Problem files: strict YAML in, the merged problem out."""
