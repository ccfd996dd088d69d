"""A reader of the PLY files that `report.ply_glb` writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """(M, 3) positions, (M, 3) colours, and (M, 3) normals or None, after the file's own header."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in header.decode("ascii").splitlines()]
    lines = [line for line in lines if line[0] != "comment"]
    assert lines[:2] == [["ply"], ["format", "binary_little_endian", "1.0"]]
    assert lines[2][:2] == ["element", "vertex"]
    types = {"float": "<f4", "uchar": "u1"}
    table = np.frombuffer(body, [(name, types[kind]) for _, kind, name in lines[3:]])
    assert len(table) == int(lines[2][2])

    def columns(*names: str) -> np.ndarray:
        return np.stack([table[name] for name in names], axis=1)

    normals = columns("nx", "ny", "nz") if "nx" in table.dtype.names else None
    return columns("x", "y", "z"), columns("red", "green", "blue"), normals
