"""How low every method of ours ends on one energy, before and after refinement.

    python benchmarks/methods.py [--out results/speed] [--scenes street,room,motorcycle]
        [--seeds 0,1] [--superpixels 1000] [--neighbours 20]

Writes methods.md: exact energies from one start by the presolve with the constrained NLP and by
on-manifold Levenberg-Marquardt, from several first smoothing widths, and what the refinement makes
of each. The same energy has many minima: this tells how far what is shipped is from the lowest.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Mapping
from dataclasses import replace
from datetime import date
from pathlib import Path

from soup_nlp.bench.speed import Spec
from soup_nlp.cases import Case, prepare
from soup_nlp.geometry.soup import Soup
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.refine.records import RefineOptions
from soup_nlp.report.atomic import atomic_path
from soup_nlp.solve.soup import solve_soup
from soup_nlp.solve.yardstick import levenberg_marquardt
from soup_nlp.timed import YARDSTICK_ITERATIONS, problem_of

ROOT = Path(__file__).parent.parent
WIDTHS = {0.1: (0.1, 0.03, 0.01), 0.3: (0.3, 0.1, 0.03, 0.01), 1.0: (1.0, 0.3, 0.1, 0.03, 0.01)}
"""Smoothing widths by the first, pixels; as shipped the first of these."""
METHODS = ("NLP 0.1", "NLP 0.3", "NLP 1", "LM 0.1", "LM 1")


def ends(case: Case) -> Mapping[str, tuple[Soup, float]]:
    """Soup and exact energy of every method, from the case's start."""
    own = case.soup, case.data, case.weights, case.formulation()
    out = {}
    for method in METHODS:
        name, first = method.split()
        eps = WIDTHS[float(first)]
        if name == "NLP":
            s = solve_soup(*own, replace(case.options, presolve_eps=eps))
            out[method] = s.soup, s.energy["total"]
        else:
            y = levenberg_marquardt(*own, eps=eps, iterations=YARDSTICK_ITERATIONS)
            out[method] = y.soup, y.energy["total"]
    return out


def refined(case: Case, soup: Soup) -> float:
    """Exact energy after the refinement as shipped."""
    form, seed = case.formulation(), case.problem.seed
    options = RefineOptions(**case.problem.refine.model_dump())
    visible = {"min_facing": form.min_facing, "depth_ratio": form.depth_ratio}
    r = refine_soup(soup, case.data, case.weights, options, seed=seed, **visible)
    return r.energy["total"]


def main() -> None:
    """Solve all, write the table after each pair."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "speed")
    parser.add_argument("--scenes", default="street,room,motorcycle")
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--superpixels", type=int, default=1000)
    parser.add_argument("--neighbours", type=int, default=20)
    args = parser.parse_args()
    head = ["pair", "N", *METHODS, "shipped / least", "refined, of each", "shipped / least"]
    lines = [
        "Exact energy E by method and first smoothing width (px), from one start; LM: on-manifold"
        " Levenberg-Marquardt. Then after the refinement as shipped, of each in the same order."
        f" DIS flow, K = {args.neighbours}. {date.today()}, {platform.machine()}.",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
    ]
    args.out.mkdir(parents=True, exist_ok=True)
    for scene in args.scenes.split(","):
        for seed in map(int, args.seeds.split(",")):
            if scene == "motorcycle" and seed:
                # a real pair: the seed draws nothing but particles
                continue
            case = prepare(problem_of(Spec(scene, args.superpixels, args.neighbours, seed)))
            found = ends(case)
            before = [energy for _, energy in found.values()]
            after = [refined(case, soup) for soup, _ in found.values()]
            cells = (
                f"{scene} {seed}",
                str(len(case)),
                *(f"{e:.2f}" for e in before),
                f"{before[0] / min(before):.4f}",
                " ".join(f"{e:.2f}" for e in after),
                f"{after[0] / min(after):.4f}",
            )
            lines.append("| " + " | ".join(cells) + " |")
            print(lines[-1], flush=True)
            with atomic_path(args.out / "methods.md") as path:
                path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
