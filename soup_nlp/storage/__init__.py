"""Files that appear whole, HDF5 with units, JSON, versions."""
