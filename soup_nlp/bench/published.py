"""Mean relative errors printed in the paper, copied; this program measured none of them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

SOURCE = "Superpixel Soup (Kumar, Dai, Li, TPAMI), table of the performance comparison"
PROTOCOL = "MRE after one global scale; the paper names neither the scale rule nor a depth cap"

_COLUMNS = ("DT", "GLRT", "BMM", "PTA", "DMDE", "Superpixel Soup")
_TABLE: dict[str, tuple[float | None, ...]] = {
    "sintel": (0.4833, 0.4101, 0.3121, 0.3177, 0.297, 0.1643),
    "vkitti": (0.2630, 0.3237, 0.2894, 0.2742, None, 0.0925),
    "kitti": (0.2703, 0.4112, 0.3903, 0.4090, 0.148, 0.1254),
    "kinect_paper": (0.2040, 0.0920, 0.0322, 0.0520, None, 0.0472),
    "kinect_tshirt": (0.2170, 0.1030, 0.0443, 0.0420, None, 0.0480),
}
COMPARISON: Mapping[str, Mapping[str, float | None]] = {
    # ULDEMV is compared in a figure of the paper, without printed numbers
    dataset: {**dict(zip(_COLUMNS, row, strict=True)), "ULDEMV": None}
    for dataset, row in _TABLE.items()
}
"""MRE by dataset and method; None where the paper prints none. KITTI is the odometry set 00-09
with LiDAR truth, not the stereo and flow sets of the suites."""

ABLATION: Mapping[str, tuple[float, float, float, float]] = MappingProxyType(
    {
        "alley_1": (0.2248, 0.2022, 0.1697, 0.1606),
        "ambush_4": (0.2381, 0.2093, 0.1701, 0.1676),
        "mountain_1": (0.2127, 0.1923, 0.1492, 0.1405),
        "sleeping_1": (0.2418, 0.2026, 0.1912, 0.1823),
    }
)
"""MRE with E_arap, + E_proj, + E_cont, + E_orient (the paper's ablation table)."""

GRID_AGAINST_SLIC = MappingProxyType({"slic": 0.0912, "grid": 0.1442})
"""MRE of one frame with 1,000 superpixels, by method of segmentation."""

DATA: Mapping[str, str] = MappingProxyType(
    {
        "sintel": "The paper names the five sequences and 120 pairs, not which pairs",
        "vkitti": "The paper names the four worlds and 120 pairs, not which pairs",
        "kitti": "Published rows are of the odometry set 00-09 with LiDAR truth, measured ones of"
        " the stereo and flow training set with its own truth",
        "kinect_paper": "Measured rows are of the pairs in the folder, whichever those are",
        "kinect_tshirt": "Measured rows are of the pairs in the folder, whichever those are",
    }
)
"""Pairs that the published and the measured numbers of a dataset are of, as far as known."""

_DATASET = {"kitti2012": "kitti", "kitti2015": "kitti"}


def published(suite: str) -> tuple[dict[str, float | None], str]:
    """Published MRE by method, and how its pairs differ from the measured; ({}, "") if none."""
    dataset = _DATASET.get(suite, suite)
    return dict(COMPARISON.get(dataset, {})), DATA.get(dataset, "")
