"""Validated option records: the base class, ranges as types, and errors that name file and key."""
