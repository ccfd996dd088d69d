"""Memory that a problem needs, estimated before it is taken."""

from __future__ import annotations

from soup_nlp.config.problem import Problem
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError
from soup_nlp.storage.memory import require_memory

PIXEL = 800
"""Bytes per pixel of the reference image: flow in both directions, superpixels, maps, pictures."""
ROW = 5_000
"""Bytes per sampled pixel or boundary point: its row of data and its part of the derivatives."""
EDGE = 20_000
"""Bytes per edge and neighbour pair in the two programs and their factors."""
NEIGHBOURS = 3
"""Neighbour pairs per superpixel; a planar graph has no more."""


def estimate(problem: Problem, pair: Pair) -> dict[str, float]:
    """Bytes that a solve takes, by what takes them; sums of measured parts, right within a factor
    of two."""
    s, r = problem.segmentation, problem.refine
    height, width = pair.size
    pixels, n = height * width, s.superpixels
    graph = n * (s.neighbours + NEIGHBOURS)
    # a superpixel cannot have more samples than pixels, nor more boundary than its own
    sampled = problem.energy.pixel_samples
    inside = pixels if sampled == "all" else min(pixels, n * sampled)
    around = 4 * (pixels / n) ** 0.5
    points = around if s.boundary_samples == "all" else min(around, s.boundary_samples)
    tables = 2.0 * graph * r.particles**2 * 8 if r.enabled else 0.0
    return {
        "images": float(PIXEL * pixels),
        "sampled pixels": float(ROW * inside),
        "boundary points": ROW * n * NEIGHBOURS * points,
        "graph": float(EDGE * graph),
        "particles": tables,
    }


LOWER = {
    "images": "smaller images, with their intrinsics",
    "sampled pixels": "a lower energy.pixel_samples",
    "boundary points": "a lower segmentation.boundary_samples",
    "graph": "a lower segmentation.superpixels or segmentation.neighbours",
    "particles": "a lower refine.particles, segmentation.superpixels or segmentation.neighbours",
}
"""What makes each part smaller."""


def check_fits(problem: Problem, pair: Pair) -> None:
    """Raise DataError for more superpixels than the image has room for, or too little memory."""
    n, height, width = problem.segmentation.superpixels, *pair.size
    if n > height * width // 4:
        raise DataError(
            "number of superpixels does not fit the image",
            where="segmentation.superpixels",
            found=n,
            expected=f"1 to {height * width // 4} for {width}x{height}",
        )
    parts = estimate(problem, pair)
    most = max(parts, key=lambda name: parts[name])
    shares = ", ".join(f"{name} {value / 1e9:.3g} GB" for name, value in parts.items())
    require_memory(sum(parts.values()), "this problem", shares, LOWER[most])
