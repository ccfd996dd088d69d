"""Command evaluate: the depth of a result against a truth file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from soup_nlp.errors import ConfigError
from soup_nlp.evaluate.metrics import Scale
from soup_nlp.evaluate.scoring import evaluate as evaluate_folder
from soup_nlp.report.verdict import accuracy, protocol


def evaluate(
    folder: Annotated[Path, typer.Argument(help="Result folder.")],
    depth: Annotated[Path, typer.Option(help="True depth: .dpt, .npy, .pfm or 16-bit .png.")],
    scale: Annotated[str, typer.Option(help="median, mre, lsq or none.")] = "median",
    cap: Annotated[float | None, typer.Option(help="Drop truth beyond this depth.")] = None,
    depth_scale: Annotated[
        float, typer.Option(help="Values per unit of length of a .png (KITTI 256).")
    ] = 1000.0,
) -> None:
    """Score a result against a truth file."""
    rules = get_args(Scale)
    if scale not in rules:
        raise ConfigError(
            "unknown scale rule", where="--scale", found=scale, expected=", ".join(rules)
        )
    scores = evaluate_folder(
        folder, depth, scale=cast(Scale, scale), cap=cap, depth_scale=depth_scale
    )
    print(protocol(scores))
    print("\n".join(accuracy(scores)))
