"""Files in, a checked `Pair` out: readers, flow sources, datasets, rendered scenes."""
