"""Discrete labellings: pairwise energies minimised by TRW-S, independent of soups."""
