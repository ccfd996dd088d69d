"""Discrete labellings: pairwise energies minimised by TRW-S; knows nothing of soups."""
