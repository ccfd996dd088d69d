"""Time and memory of TRW-S at 1,000 nodes, about 8,700 edges and 50 labels.

Run: ``OMP_NUM_THREADS=1 python benchmarks/bench_trws.py [iterations]``. Every case runs in its own
process, so that its peak memory (resident set, tables and interpreter included) is its own.
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time

import numpy as np
from scipy.spatial import cKDTree

from soup_nlp.mrf.levels import colours
from soup_nlp.mrf.trws import solve_trws

NODES, LABELS, NEIGHBOURS = 1000, 50, 15


def make_edges(seed: int = 0) -> np.ndarray:
    """(E, 2) each node with its nearest neighbours, each pair once."""
    points = np.random.default_rng(seed).random((NODES, 2))
    near = cKDTree(points).query(points, NEIGHBOURS + 1)[1][:, 1:]
    pairs = np.stack([np.repeat(np.arange(NODES), NEIGHBOURS), near.ravel()], axis=1)
    return np.unique(np.sort(pairs, axis=1), axis=0)


def run(dtype: str, iterations: int) -> None:
    """Print one case: its levels, milliseconds an iteration, peak memory and final figures."""
    rng = np.random.default_rng(1)
    edges = make_edges()
    unary = rng.random((NODES, LABELS))
    seed = rng.random((LABELS, LABELS)).astype(dtype)
    tables = seed * (1.0 + (np.arange(len(edges)) % 7)[:, None, None].astype(dtype))
    stamps: list[float] = []
    result = solve_trws(
        unary,
        edges,
        tables,
        dtype=np.dtype(dtype),
        max_iter=iterations,
        gap=-1.0,
        stagnation=-1.0,
        callback=lambda *_: stamps.append(time.perf_counter()),
    )
    each = 1e3 * np.diff(stamps)
    levels = int(colours(NODES, edges).max()) + 1
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{dtype:8s} {len(edges):6d} edges {levels:4d} levels "
        f"{np.median(each):7.1f} ms/iteration (least {each.min():.1f}) {peak:6.0f} MiB peak  "
        f"bound {result.lower_bound:.4f} energy {result.energy:.4f}",
        flush=True,
    )


def main() -> None:
    """Run both types, one process each."""
    iterations = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    context = multiprocessing.get_context("spawn")
    for dtype in ("float64", "float32"):
        worker = context.Process(target=run, args=(dtype, iterations))
        worker.start()
        worker.join()
        if worker.exitcode:
            sys.exit(worker.exitcode)


if __name__ == "__main__":
    main()
