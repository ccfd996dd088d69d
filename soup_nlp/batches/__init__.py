"""Many pairs: a table and a folder of results."""
