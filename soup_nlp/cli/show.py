"""Commands show and list: one merged problem, and what problems there are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli.options import Problem, Set
from soup_nlp.config.problem import dump_problem, load_problem
from soup_nlp.data.scenes.catalogue import SCENES


def show(problem: Problem, overrides: Set = None) -> None:
    """Print the merged problem and its hash."""
    chosen = load_problem(problem, overrides or [])
    print(dump_problem(chosen), end="")
    print(f"# hash {chosen.digest()}")


def list_(
    folder: Annotated[Path, typer.Argument(help="Folder of problem files.")] = Path("problems"),
) -> None:
    """Print the problem files of a folder and the rendered scenes."""
    for path in sorted(folder.glob("*.yaml")):
        first = path.read_text(encoding="utf-8").partition("\n")[0]
        print(f"{path!s:<28} {first.removeprefix('#').strip() if first[:1] == '#' else ''}")
    if folder.is_dir():
        print()
    for name, text in SCENES.items():
        print(f"scene {name:<22} {text}")
