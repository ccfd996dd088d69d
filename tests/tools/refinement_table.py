"""Print what the refinement minimises and what it does to depth: a Markdown table, a row per pair.

    python tests/tools/refinement_table.py [--data DIR] [--superpixels N] [WORD ...]

E of NLP and solution; the objective (E + E_photo, equation 27 of docs/formulation.md) of
initialisation, NLP and solution; superpixels whose flow the images contradict; MRE without and with
the refinement; its rounds and seconds. DIS flow. A word selects pairs whose names contain it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from soup_nlp.bench.study import Item
from soup_nlp.bench.suites import Options, list_suite
from soup_nlp.pipeline.run import run

HEAD = (
    "| pair | contradicted | E: NLP | solution | E + E_photo: start | NLP | solution | MRE: NLP"
    " | solution | rounds | s |"
)


def items(data: Path | None, words: tuple[str, ...]) -> tuple[Item, ...]:
    """Rendered pairs; with a folder of data the real ones."""
    suite = "shared" if data else "rendered"
    return list_suite(suite, data, Options(flows=("dis",), only=words)).items


def row(item: Item, superpixels: int) -> str:
    """The row of a pair."""
    done = run(item.problem([f"segmentation.superpixels={superpixels}"]))
    r, of = done.refined, done.metrics
    assert r is not None
    lowered = [e["total"] for e in (r.energy_start, r.energy_begin, r.energy)]
    cells = [
        item.name,
        f"{r.contradicted} of {len(done.segmentation)}",
        *(f"{e['total']:.1f}" for e in (done.solution.energy, done.energy)),
        *(f"{e:.1f}" for e in lowered),
        *(f"{of[k].mre:.4f}" for k in ("nlp", "solution")),
        f"{len(r.rounds)}, {r.status}",
        f"{r.seconds:.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--superpixels", type=int, default=1000)
    o = parser.parse_args()
    print(HEAD)
    print("|---" * HEAD.count(" |") + "|")
    for one in items(o.data, tuple(o.words)):
        print(row(one, o.superpixels), flush=True)
