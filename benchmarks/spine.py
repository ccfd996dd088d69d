"""Every problem of the spine with the one default configuration: results/spine/table.md.

    python benchmarks/spine.py [--data ../shared/data] [--out out/spine] [--only street,room]

A run whose folder already holds a summary is not repeated, so the table can be resumed. Real
pairs are measured where --data holds them (kitti2012/, driving_synthetic/ and so on) and skipped
elsewhere. `soup-nlp bench accuracy` measures the same pairs beside their rivals.
"""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

from soup_nlp import run
from soup_nlp.bench.suites import list_suite
from soup_nlp.config import Problem, dump_problem
from soup_nlp.report.folder import prepare_folder, write_folder

ROOT = Path(__file__).parent.parent


def problems(data: Path) -> Iterator[tuple[str, str, Problem]]:
    """(name, flow source, problem): the rendered scenes and the real pairs that are there."""
    items = list(list_suite("rendered").items)
    if data.is_dir():
        items += list_suite("shared", data).items
    for item in items:
        name = item.sequence if item.suite == "rendered" else item.name
        yield name, item.flow, item.problem()


def row(name: str, flow: str, summary: dict[str, Any]) -> str:
    """One line of the table."""
    m, e = summary["metrics"], summary["energy"]
    rigid = m.get("rigid")
    cells = [
        name,
        flow,
        f"{e['start']['total']:.1f}",
        f"{e['solution']['total']:.1f}",
        f"{m['start']['mre']:.4f}",
        f"**{m['solution']['mre']:.4f}**",
        f"{m['solution']['median_relative']:.4f}",
        f"{rigid['mre']:.4f} ({rigid['coverage']:.0%})" if rigid and rigid["mre"] else "-",
        f"{m['constant']['mre']:.4f}",
        f"{sum(summary['iterations'].values())}",
        f"{sum(v for k, v in summary['seconds'].items() if not k.startswith('nlp_')):.0f}",
        "yes" if summary["converged"] else summary["status"],
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Run what is missing, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "spine")
    parser.add_argument("--only", default="", help="names, comma separated")
    args = parser.parse_args()
    only = {s for s in args.only.split(",") if s}
    lines = []
    for name, flow, problem in problems(args.data):
        if only and name not in only:
            continue
        folder = prepare_folder(args.out / f"{name.replace(' ', '_')}_{flow}")
        if not (folder / "summary.json").exists():
            print("solving", name, flow, flush=True)
            result = run(problem, ipopt_log=str(folder / "ipopt.log"))
            write_folder(folder, result, dump_problem(problem), "")
        lines.append(row(name, flow, json.loads((folder / "summary.json").read_text())))
        print(lines[-1], flush=True)
    head = [
        f"N = 1,000, K = 15, one default configuration. MRE after median scale, no cap, "
        f"coverage 100 % unless named. {date.today()}, {platform.machine()}.",
        "",
        "| pair | flow | E start | E solution | MRE start | MRE | median error | one rigid motion"
        " (coverage) | constant depth | iterations | seconds | converged |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    target = ROOT / "results" / "spine" / "table.md"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text("\n".join([*head, *lines]) + "\n")


if __name__ == "__main__":
    main()
