"""Components that the lower border cuts off: depth with and without what the start says of them.

    python benchmarks/cut_off.py [--out results/accuracy] [--seeds 0,1,2,3,4,5,6,7]
        [--superpixels 500] [--lower 0.3]

Writes cut_off.md: mean relative errors of start and NLP on rendered streets and rooms without their
lower part, where what moving components stand on is not seen; by contact alone, and as shipped.
"""

from __future__ import annotations

import argparse
import platform
from dataclasses import replace
from datetime import date
from pathlib import Path
from unittest import mock

import numpy as np

from soup_nlp.bench.accuracy_table import table
from soup_nlp.bench.pair_views import cropped
from soup_nlp.config.problem import make_problem
from soup_nlp.pipeline.run import run
from soup_nlp.storage.atomic import atomic_path

ROOT = Path(__file__).parent.parent
NEARER = "soup_nlp.start.components.nearer_where_cut_off"


def errors(scene: str, seed: int, superpixels: int, lower: float) -> tuple[list[float], int]:
    """MRE of start and NLP by contact, the same as shipped; how many true components are cut
    off."""
    problem = make_problem(
        {
            "input": {"kind": "scene", "scene": scene, "seed": seed},
            "segmentation": {"superpixels": superpixels},
            "refine": {"enabled": False},
        }
    )
    whole = problem.load_pair()
    pair = replace(cropped(whole, 0, 0, 0, int(lower * whole.image_ref.shape[0])), flow=None)
    assert pair.truth is not None
    assert pair.truth.components is not None
    found: list[float] = []
    for contact in (True, False):
        if contact:
            with mock.patch(NEARER, lambda soup, label, log_scale, *rest: 0 * log_scale):
                metrics = run(problem, pair=pair).metrics
        else:
            metrics = run(problem, pair=pair).metrics
        found += [metrics["start"].mre, metrics["solution"].mre]
    last = pair.truth.components[-1]
    return found, len(np.unique(last[last > 0]))


def main() -> None:
    """Solve all, write the table after each pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "accuracy")
    parser.add_argument("--seeds", default="0,1,2,3,4,5,6,7")
    parser.add_argument("--superpixels", type=int, default=500)
    parser.add_argument("--lower", type=float, default=0.3, help="share of the rows left out")
    args = parser.parse_args()
    note = (
        f"MRE (median scale, no cap) of rendered pairs without the lower {args.lower:.0%} of their"
        " rows, by contact alone and as shipped: what the lower border cuts off is nearer than what"
        f" it touches (`start.components`). DIS flow, {args.superpixels} superpixels, NLP without"
        f" refinement. {date.today()}, {platform.machine()}."
    )
    head = ["pair, seed", "components cut off", "start, contact", "NLP, contact", "start", "NLP"]
    rows: list[list[str]] = []
    args.out.mkdir(parents=True, exist_ok=True)
    for scene in ("street", "room"):
        values = []
        for seed in map(int, args.seeds.split(",")):
            found, cut = errors(scene, seed, args.superpixels, args.lower)
            values.append(found)
            rows.append([f"{scene}, {seed}", str(cut), *(f"{v:.4f}" for v in found)])
            print(*rows[-1], sep="  ", flush=True)
            with atomic_path(args.out / "cut_off.md") as path:
                path.write_text("\n".join([note, "", *table(head, rows)]) + "\n")
        rows.append([f"{scene}, mean", "", *(f"{v:.4f}" for v in np.mean(values, axis=0))])
    with atomic_path(args.out / "cut_off.md") as path:
        path.write_text("\n".join([note, "", *table(head, rows)]) + "\n")


if __name__ == "__main__":
    main()
