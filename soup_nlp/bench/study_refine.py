"""What each half contributes: start, refinement only, NLP only, both; E and MRE of every scene."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

from soup_nlp.bench.accuracy import scores
from soup_nlp.bench.rows import Row, Say
from soup_nlp.bench.studies import made_on, run_study
from soup_nlp.bench.suite_pairs import RENDERED
from soup_nlp.bench.tables import table
from soup_nlp.config.problem import make_problem
from soup_nlp.pipeline.run import run

SCENES = (*RENDERED, "motorcycle")
VARIANTS = {"both": [], "refinement": ["refine.from_start=true"], "polish": ["refine.polish=true"]}
HEAD = (
    "scene", "E start", "refinement only", "NLP only", "both", "below NLP", "gap", "monotone",
    "MRE start", "refinement only", "NLP only", "both", "seconds", "GiB", "NLP",
)  # fmt: skip


def measure(scene: str, variant: str, superpixels: int) -> Row:
    """Solve one scene in one variant."""
    source = {"kind": "scene", "scene": scene} if scene in RENDERED else {"kind": scene}
    changes = [f"segmentation.superpixels={superpixels}", *VARIANTS[variant]]
    result = run(make_problem({"name": scene, "input": source}, changes))
    refined = result.refined
    assert refined is not None
    last = refined.rounds[-1]
    totals = [refined.energy_begin["total"], *(r.energy["total"] for r in refined.rounds)]
    found = scores(result)
    return {
        "status": found["status"],
        "energy": {name: e["total"] for name, e in found["energy"].items()},
        "mre": {name: m["mre"] for name, m in found["metrics"]["paper"].items()},
        "gap": last.gap / last.mrf_energy,
        "monotone": all(b <= a for a, b in itertools.pairwise(totals)),
        "refine_seconds": refined.seconds,
        "polish_gain": refined.polish_gain,
    }


def study(
    out: Path, only: Sequence[str], superpixels: int, polish: bool, say: Say | None = None
) -> list[Row]:
    """Write OUT/table.md."""
    names = ("both", "refinement", "polish") if polish else ("both", "refinement")
    settings = [
        {"scene": scene, "variant": name, "superpixels": superpixels}
        for scene in only
        for name in names
    ]
    note = (
        f"Flow by DIS, {superpixels} superpixels wanted, K = 15, 50 particles, at most 10 rounds;"
        " MRE after median scale, no cap. Both = NLP, then refinement. The gap is how far the"
        " choice of the last round can be from the best one among its particles. Seconds: wall"
        " time of the refinement of both; memory: peak of the whole process, with and without the"
        f" NLP. {made_on()}"
    )

    def text(rows: Sequence[Row]) -> list[str]:
        own = {(r["settings"]["scene"], r["settings"]["variant"]): r for r in rows}
        done = [s for s in only if (s, "both") in own and (s, "refinement") in own]
        lines = [
            note,
            "",
            *table(HEAD, [_line(s, own[s, "both"], own[s, "refinement"]) for s in done]),
        ]
        gains = [
            [s, f"{r['energy']['solution']:.2f}", f"{r['polish_gain']:.3g}"]
            for (s, name), r in own.items()
            if name == "polish"
        ]
        head = ["scene", "E both", "lowered by a polish of the NLP"]
        return [*lines, "", *table(head, gains)] if gains else lines

    return run_study(out / "table.md", settings, measure, text, say)


def _line(scene: str, both: Row, alone: Row) -> list[str]:
    def four(name: str, form: str) -> list[str]:
        own = both[name]
        values = own["start"], alone[name]["solution"], own["nlp"], own["solution"]
        return [format(v, form) for v in values]

    peak = [f"{r['peak_bytes'] / 2**30:.2f}" for r in (both, alone)]
    return [
        scene,
        *four("energy", ".2f"),
        f"{1 - both['energy']['solution'] / both['energy']['nlp']:.1%}",
        f"{both['gap']:.2%}",
        "yes" if both["monotone"] else "NO",
        *four("mre", ".5f"),
        f"{both['refine_seconds']:.0f}",
        " / ".join(peak),
        both["status"],
    ]
