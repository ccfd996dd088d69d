"""Seconds and memory of whole solves over N and the size of the images."""

from __future__ import annotations

from itertools import product

import pandas as pd

from soup_nlp.bench.study import (
    Cell,
    Item,
    failures,
    markdown,
    page_text,
    pivot,
    provenance,
)

SIZES = ((512, 218), (1024, 436), (1792, 763))
"""Columns and rows of the images; the largest are just below the limit of the working size."""
SUPERPIXELS = (250, 1000, 2000)
TABLES = {
    "seconds": ("Seconds from the images to the scored depth of both frames", ".0f"),
    "GB": ("Peak memory, GB", ".1f"),
    "mre": ("MRE", ".4f"),
}
"""Title and format of the tables by column."""


def cost_cells() -> list[Cell]:
    """Rendered streets with the default options, small ones first."""
    return [
        Cell(
            Item(
                "cost",
                "street",
                f"street {width} x {height}",
                "dis",
                {"kind": "scene", "scene": "street", "width": width, "height": height},
            ),
            (f"segmentation.superpixels={n}",),
            f"N = {n}",
        )
        for (width, height), n in product(SIZES, SUPERPIXELS)
    ]


def cost_page(frame: pd.DataFrame) -> str:
    """Tables with a line for each size and a column for each N; rendering is left out."""
    lines = ["# Time and memory", "", f"{provenance(frame)}. One process with one thread.", ""]
    good = frame[frame["ok"].eq(True)]
    if len(good):
        left_out = ("stages.nlp_", "stages.load")
        stages = [c for c in good if c.startswith("stages.") and not c.startswith(left_out)]
        costs = {"seconds": good[stages].sum(axis=1), "GB": good["peak_bytes"] / 2**30}
        good = good.assign(**costs)
        for column, (title, form) in TABLES.items():
            lines += [f"## {title}", "", *markdown(pivot(good, column, average=False), form), ""]
    return page_text([*lines, *failures(frame)])
