"""Loaders of datasets in their official layouts."""
