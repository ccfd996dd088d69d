"""Make the pictures of gallery.md and the verdicts below them: `python docs/gallery.py`."""

from __future__ import annotations

import re
from pathlib import Path

from PIL import Image

import soup_nlp
from soup_nlp.report.figures import strip
from soup_nlp.report.findings import certainty, certainty_lines, found_words, hints, summary
from soup_nlp.report.pictures import pictures
from soup_nlp.report.result import result_of
from soup_nlp.report.verdict import sectioned

PAGE = Path(__file__).with_name("gallery.md")
OPTIONS = ("segmentation.superpixels=300",)
PANELS = ("image_ref", "depth_ref", "confidence", "depth_true")
PLACE = re.compile(r"\(gallery/(\w+)\.jpg\)\n\n```text\n.*?```", re.DOTALL)
"""A picture, named after its scene, and the verdict below it."""


def made(scene: str) -> str:
    """Solve a scene, write its picture, and return the verdict on its depth."""
    source = {"kind": "scene", "scene": scene, "width": 640, "height": 480}
    run = soup_nlp.run(soup_nlp.make_problem({"name": scene, "input": source}, OPTIONS))
    drawn = pictures(result_of(run, summary(run)))
    sheet = strip([drawn[name] for name in PANELS], "", columns=len(PANELS), panel_width=270)
    Image.fromarray(sheet).save(PAGE.with_name("gallery") / f"{scene}.jpg", quality=80)
    shares = certainty(run)
    scores = (f"{name} {run.metrics[name].mre:.3f}" for name in ("solution", "constant"))
    sections = {
        "found": found_words(run),
        "certainty": certainty_lines(shares),
        "try": hints(run.pair.flow.uv, run.pair.flow.confidence, shares),
        "MRE": [", ".join(scores)],
        "exit code": [f"{0 if run.good else 1}"],
    }
    return sectioned(sections) + "\n"


if __name__ == "__main__":
    PAGE.with_name("gallery").mkdir(exist_ok=True)
    words = PAGE.read_text(encoding="utf-8")
    words = PLACE.sub(lambda m: f"(gallery/{m[1]}.jpg)\n\n```text\n{made(m[1])}```", words)
    PAGE.write_text(words, encoding="utf-8")
