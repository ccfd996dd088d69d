"""Files that appear whole, HDF5 with units, JSON, rows of worker processes, progress, versions."""
