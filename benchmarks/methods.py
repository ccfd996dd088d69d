"""How low every method of ours ends on one energy, before and after refinement.

    python benchmarks/methods.py [--out results/speed] [--scenes street,room,motorcycle]
        [--seeds 0,1] [--superpixels 1000] [--neighbours 20] [--unrefined]

Writes methods.md: exact energies from one start by the presolve with the constrained NLP and by
on-manifold Levenberg-Marquardt, from several first smoothing widths, and what the refinement makes
of each; with --unrefined methods_unrefined.md, without the latter. The same energy has many
minima: this tells how far what is shipped is from the lowest.
"""

from __future__ import annotations

import argparse
import platform
from datetime import date
from pathlib import Path

from soup_nlp.bench.accuracy_table import table
from soup_nlp.bench.speed import plan
from soup_nlp.bench.timed import YARDSTICK_ITERATIONS, problem_of
from soup_nlp.bench.yardstick import EPS, levenberg_marquardt
from soup_nlp.geometry.soup import Soup
from soup_nlp.pipeline.case import Case, prepare
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.atomic import atomic_path

ROOT = Path(__file__).parent.parent
METHODS = {
    "NLP as shipped": None,
    "NLP from 0.1": 0.1,
    "NLP from 1": 1.0,
    "LM from 0.3": 0.3,
    "LM from 1": 1.0,
}
"""First smoothing width by method, pixels; the next ones are those of EPS below it."""


def solved(case: Case, method: str) -> tuple[Soup, float]:
    """Soup and exact energy of a method, from the case's start."""
    own = case.soup, case.data, case.weights, case.formulation()
    first = METHODS[method]
    eps = case.options.presolve_eps if first is None else EPS[EPS.index(first) :]
    if method.startswith("NLP"):
        s = solve_soup(*own, case.options.replace(presolve_eps=eps))
        return s.soup, s.energy["total"]
    y = levenberg_marquardt(*own, eps=eps, iterations=YARDSTICK_ITERATIONS)
    return y.soup, y.energy["total"]


def refined(case: Case, soup: Soup) -> float:
    """Exact energy after the refinement as shipped."""
    form = case.formulation()
    r = refine_soup(
        soup,
        case.data,
        case.weights,
        case.problem.refine,
        seed=case.problem.seed,
        min_facing=form.min_facing,
        depth_ratio=form.depth_ratio,
    )
    return r.energy["total"]


def main() -> None:
    """Solve all, write the table after each pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "speed")
    parser.add_argument("--scenes", default="street,room,motorcycle")
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--superpixels", default="1000", help="numbers, with commas")
    parser.add_argument("--neighbours", type=int, default=20)
    parser.add_argument("--unrefined", action="store_true", help="leave the refinement out")
    args = parser.parse_args()
    sizes = [int(size) for size in args.superpixels.split(",")]
    seeds = [int(seed) for seed in args.seeds.split(",")]
    note = (
        "Exact energy E by method and first smoothing width (px) from one start"
        + ("" if args.unrefined else ", and what the refinement as shipped makes of it")
        + ". LM: on-manifold Levenberg-Marquardt. DIS flow,"
        f" K = {args.neighbours}. {date.today()}, {platform.machine()}."
    )
    head = ["pair, seed", "N", *METHODS, "shipped / least"]
    head += [] if args.unrefined else ["both refined"]
    name = "methods_unrefined.md" if args.unrefined else "methods.md"
    rows: list[list[str]] = []
    args.out.mkdir(parents=True, exist_ok=True)
    for spec in plan(args.scenes.split(","), sizes, [args.neighbours], seeds):
        case = prepare(problem_of(spec))
        found = [solved(case, method) for method in METHODS]
        before = [energy for _, energy in found]
        cells, ratios = [f"{energy:.2f}" for energy in before], [before]
        if not args.unrefined:
            after = [refined(case, soup) for soup, _ in found]
            cells = [f"{cell} -> {energy:.2f}" for cell, energy in zip(cells, after)]
            ratios.append(after)
        rows.append(
            [f"{spec.scene}, {spec.seed}", str(len(case)), *cells]
            + [f"{energies[0] / min(energies):.4f}" for energies in ratios]
        )
        print(*rows[-1], sep="  ", flush=True)
        with atomic_path(args.out / name) as path:
            path.write_text("\n".join([note, "", *table(head, rows)]) + "\n")


if __name__ == "__main__":
    main()
