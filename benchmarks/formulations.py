"""Every gauge, norm and truncation of the constrained NLP from one presolve: who converges.

    python benchmarks/formulations.py [--out results/speed] [--superpixels 250] [--scene street]

Writes formulations.md: status, iterations, residuals and energy of each.
"""

from __future__ import annotations

import argparse
import itertools
import platform
import time
from dataclasses import replace
from datetime import date
from pathlib import Path

from soup_nlp.config.problem import load_problem
from soup_nlp.model.layout import GAUGES
from soup_nlp.pipeline.case import prepare
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.atomic import atomic_path

ROOT = Path(__file__).parent.parent
HEAD = (
    "| gauge | norm | truncation | status | presolve its | NLP its | CPU s | E | dual infeasibility"
    " | SO(3) | violation | complementarity |"
)


def main() -> None:
    """Solve all twelve, write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "speed")
    parser.add_argument("--superpixels", type=int, default=250)
    parser.add_argument("--scene", default="street")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--seconds", type=float, default=240.0)
    args = parser.parse_args()
    changes = [f"segmentation.superpixels={args.superpixels}", "flow.source=truth"]
    case = prepare(load_problem(ROOT / "problems" / f"{args.scene}.yaml", changes))
    limits = {"max_iter": args.iterations, "far_iterations": args.iterations}
    options = case.options.replace(**limits, max_seconds=args.seconds)
    lines = [
        f"{args.scene}, true flow, {len(case)} superpixels; constrained NLP to 1e-6 from the same"
        f" presolve, at most {args.iterations} iterations. {date.today()}, {platform.machine()},"
        " one thread.",
        "",
        HEAD,
        "|" + "---|" * 12,
    ]
    args.out.mkdir(parents=True, exist_ok=True)
    for norm, truncation, gauge in itertools.product(
        ("smooth", "epigraph"), ("smooth", "lifted"), GAUGES
    ):
        form = replace(case.formulation(), gauge=gauge, norm=norm, truncation=truncation)
        begin = time.process_time()
        s = solve_soup(case.soup, case.data, case.weights, form, options)
        r = s.residuals
        cells = (
            gauge,
            norm,
            truncation,
            s.status.replace("_", " "),
            str(sum(stage.iterations for stage in s.stages[:-1])),
            str(s.stages[-1].iterations),
            f"{time.process_time() - begin:.1f}",
            f"{s.energy['total']:.4f}",
            f"{r['dual_infeasibility']:.1e}",
            f"{r['so3']:.1e}",
            f"{r['nlp_infeasibility']:.1e}",
            f"{r['complementarity']:.1e}",
        )
        lines.append("| " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
        with atomic_path(args.out / "formulations.md") as path:
            path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
