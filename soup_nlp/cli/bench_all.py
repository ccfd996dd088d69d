"""Command bench all: run the commands that make everything under results/."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli.options import Data, Overwrite
from soup_nlp.errors import ConfigError
from soup_nlp.storage.files import is_folder
from soup_nlp.storage.folders import claim, staged

THREE = "--suite rendered --only street --only room --only orbit"
NLP = "--set refine.enabled=false"
COMMANDS = (
    "solve problems/motorcycle.yaml -o out/motorcycle",
    "bench accuracy -o {out}/accuracy --suite rendered --suite shared --data {data}",
    f"bench search -o {{out}}/accuracy {THREE} --flow dis --trials 8 --seeds 0"
    f" --width 512 --set segmentation.superpixels=300 {NLP}",
    "bench accuracy -o {out}/accuracy --name banner --suite rendered --only banner"
    " --seeds 0,1,2,3,4,5 --flow truth --flow dis",
    "bench chain -o {out}/accuracy --data {data}",
    "bench paper -o {out}/paper --data {data} --limit 2 --superpixels 500 --analysis 250",
    "bench speed -o {out}/speed --superpixels 500,1000,2000 --neighbours 20",
    "bench cost -o {out}/speed",
    "family out/matrix --sizes 100 --starts hard",
    "family out/tangent --sizes 100,250 --starts hard --coordinates tangent",
    "compare out/matrix out/tangent -o {out}/solvers --seconds 20 --iterations 500"
    " --solvers ipopt,ipopt-soup,ipopt-lbfgs,sqpmethod,uno,fatrop,pounce,lm,soup-nlp",
)
"""Commands in the order in which they run."""
LONGEST_PATH = 4_096
"""Bytes of the longest path that Linux takes."""


def everything(
    data: Data = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder.")] = Path("out/bench"),
    overwrite: Overwrite = False,
    dry: Annotated[bool, typer.Option(help="Print the commands only.")] = False,
) -> None:
    """Make every table and picture of results/ in a folder; a run that was stopped goes on."""
    # imported here, since main imports this module
    from soup_nlp.cli.main import main

    if data is not None and not dry and not is_folder(data):
        raise ConfigError("there is no such folder", where="--data", found=data)
    if not dry:
        # check now instead of after hours
        claim(out, ["motorcycle.png"], overwrite)
    elif len(str(out)) > LONGEST_PATH:
        raise ConfigError("this name of a folder is too long", where="--out", found=len(str(out)))
    ended = {}
    for text in COMMANDS:
        if "{data}" in text and data is None:
            text = text.replace("--suite shared --data {data}", "")
            if "--suite" not in text:
                continue
        words = [w.format(out=out, data=data) for w in shlex.split(text)]
        words += ["--overwrite"] if overwrite else []
        print(f"soup-nlp {shlex.join(words)}", flush=True)
        if not dry:
            ended[shlex.join(words)] = main(words)
    if dry:
        return
    overview = Path("out/motorcycle/overview.png")
    if overview.is_file():
        with staged(claim(out, ["motorcycle.png"], overwrite)) as new:
            shutil.copy(overview, new / "motorcycle.png")
    bad = [f"{words}: exit code {code}" for words, code in ended.items() if code]
    print("\n".join(bad) or "every command ended well")
    raise typer.Exit(1 if bad else 0)
