"""What each half contributes: start, refinement only, NLP only, both; E and MRE of every scene.

    python benchmarks/refine.py [--out results/refine] [--runs out/refine] [--only street,room]
        [--superpixels 1000] [--polish]

Every solve runs in a process of its own, so that its peak memory is its own. A run whose folder
already holds its figures is not repeated, so the table can be resumed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import platform
import resource
import time
from datetime import date
from pathlib import Path
from typing import Any

from soup_nlp.config.problem import dump_problem, load_problem
from soup_nlp.pipeline.run import run
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.storage.atomic import atomic_path

ROOT = Path(__file__).parent.parent
SCENES = ("street", "room", "sheet", "orbit", "still", "motorcycle")
VARIANTS = {
    "both": [],
    "refinement": ["refine.from_start=true"],
    "polish": ["refine.polish=true"],
}


def solve(task: tuple[str, str, int, Path]) -> None:
    """Solve one scene in one variant; its figures go to figures.json of its folder."""
    scene, variant, superpixels, folder = task
    changes = [f"segmentation.superpixels={superpixels}", *VARIANTS[variant]]
    problem = load_problem(ROOT / "problems" / f"{scene}.yaml", changes)
    prepare_folder(folder)
    cpu = time.process_time()
    result = run(problem, ipopt_log=str(folder / "ipopt.log"))
    write_folder(folder, result, dump_problem(problem), "")
    figures = {
        "cpu": time.process_time() - cpu,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    with atomic_path(folder / "figures.json") as path:
        path.write_text(json.dumps(figures))


def figures(folder: Path) -> dict[str, Any]:
    """Summary of a run and what its process used."""
    summary = json.loads((folder / "summary.json").read_text())
    return {**summary, **json.loads((folder / "figures.json").read_text())}


def row(scene: str, both: dict[str, Any], alone: dict[str, Any]) -> str:
    """One line of the table: E and MRE of the four."""
    E = [
        both["energy"]["start"]["total"],
        alone["energy"]["solution"]["total"],
        both["energy"]["nlp"]["total"],
        both["energy"]["solution"]["total"],
    ]
    mre = [
        both["metrics"]["start"]["mre"],
        alone["metrics"]["solution"]["mre"],
        both["metrics"]["nlp"]["mre"],
        both["metrics"]["solution"]["mre"],
    ]
    rounds = both["refinement"]["rounds"]
    totals = [both["refinement"]["begin"]["total"], *(r["energy"]["total"] for r in rounds)]
    monotone = all(b <= a for a, b in itertools.pairwise(totals))
    cells = [
        scene,
        *(f"{e:.2f}" for e in E),
        f"{1 - E[3] / E[2]:.1%}",
        f"{rounds[-1]['gap'] / rounds[-1]['mrf_energy']:.2%}",
        "yes" if monotone else "NO",
        *(f"{m:.5f}" for m in mre),
        f"{both['refinement']['seconds']:.0f}",
        f"{both['peak_gib']:.2f} / {alone['peak_gib']:.2f}",
        both["status"],
    ]
    return "| " + " | ".join(cells) + " |"


def write(out: Path, superpixels: int, lines: list[str], polish: list[str]) -> None:
    """Write table.md whole."""
    head = [
        f"Flow by DIS, {superpixels} superpixels wanted, K = 15, 50 particles, at most 10"
        " rounds; MRE after median scale, no cap. Both = NLP, then refinement. The gap is how"
        " far the choice of the last round can be from the best one among its particles. Seconds:"
        " wall time of the"
        " refinement of both; memory: peak of the whole process, with and without the NLP."
        f" {date.today()}, {platform.machine()}, a shared machine.",
        "",
        "| scene | E start | refinement only | NLP only | both | below NLP | gap | monotone"
        " | MRE start | refinement only | NLP only | both | seconds | GiB | NLP |",
        "|" + "---|" * 15,
    ]
    text = "\n".join([*head, *lines, *polish]) + "\n"
    out.mkdir(parents=True, exist_ok=True)
    with atomic_path(out / "table.md") as path:
        path.write_text(text)


def main() -> None:
    """Run what is missing, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "refine")
    parser.add_argument("--runs", type=Path, default=ROOT / "out" / "refine")
    parser.add_argument("--only", default="", help="names, comma separated")
    parser.add_argument("--superpixels", type=int, default=1000)
    parser.add_argument("--polish", action="store_true", help="measure refine.polish as well")
    args = parser.parse_args()
    only = [s for s in args.only.split(",") if s] or list(SCENES)
    context = multiprocessing.get_context("spawn")
    lines: list[str] = []
    polish = ["", "| scene | E both | lowered by a polish of the NLP |", "|---|---|---|"]
    for scene in only:
        done = {}
        for variant in ("both", "refinement", *(["polish"] if args.polish else [])):
            folder = args.runs / f"{scene}_{args.superpixels}_{variant}"
            if not (folder / "figures.json").exists():
                print("solving", scene, variant, flush=True)
                process = context.Process(
                    target=solve, args=((scene, variant, args.superpixels, folder),)
                )
                process.start()
                process.join()
                if process.exitcode:
                    raise SystemExit(f"{scene} {variant} failed")
            done[variant] = figures(folder)
        lines.append(row(scene, done["both"], done["refinement"]))
        print(lines[-1], flush=True)
        if args.polish:
            last = done["polish"]["refinement"]
            polish.append(
                f"| {scene} | {done['polish']['energy']['solution']['total']:.2f} |"
                f" {last['polish_gain']:.3g} |"
            )
            print(polish[-1], flush=True)
        # what is there so far: the command can be stopped and taken up again
        write(args.out, args.superpixels, lines, polish if args.polish else [])


if __name__ == "__main__":
    main()
