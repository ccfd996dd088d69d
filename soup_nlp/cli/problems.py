"""Commands show and list: problems as text."""

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import option
from soup_nlp.config.problem import description, dump_problem, load_problem, shipped_problems
from soup_nlp.config.trees import PRESET_FILES
from soup_nlp.errors import ConfigError, printable
from soup_nlp.storage.files import is_folder


def show(
    problem: Annotated[
        Path | None,
        typer.Argument(help=options.PROBLEM, autocompletion=options.starting(shipped_problems)),
    ] = None,
    overrides: options.Set = None,
    preset: options.PresetName = None,
    all_options: Annotated[bool, option("Every key, also the unusual ones.", "--all")] = False,
) -> None:
    """Print the merged problem and its hash; without a problem, the options of a preset."""
    if problem is None:
        if preset is None or preset not in PRESET_FILES or overrides:
            raise ConfigError(
                "nothing to show",
                where="--preset" if preset else None,
                found=preset,
                expected=f"a problem, or --preset {' or '.join(PRESET_FILES)} alone",
            )
        print(PRESET_FILES[preset].read_text("utf-8"), end="")
        return
    chosen = load_problem(problem, options.changed(preset, overrides))
    footer = "" if all_options else "# all other options have their defaults: soup-nlp show --all\n"
    print(f"{dump_problem(chosen, all_options)}{footer}# hash {chosen.digest()}")


def list_(
    folder: Annotated[Path | None, typer.Argument(help="Folder of other problem files.")] = None,
) -> None:
    """Print the problems, scenes and formats of the package, or the problems of a folder."""
    from soup_nlp.data.scenes.catalogue import LAYOUTS
    from soup_nlp.report.formats import FORMATS

    if folder is not None and not is_folder(folder):
        raise ConfigError("no such folder", where=folder, hint="soup-nlp list without a folder")
    files = {str(p): p for p in sorted(folder.glob("*.yaml"))} if folder else shipped_problems()
    for name, path in files.items():
        print(f"{printable(name):<14} {description(path)}")
    if folder is None:
        print("\nsoup-nlp solve NAME; templates take --set input.root=DIR, folder input.path=DIR")
        print(f"soup-nlp chain scene:NAME, of {', '.join(LAYOUTS)}")
        print(f"soup-nlp convert RESULT --to {','.join(FORMATS)}")
    elif not files:
        print(f"no problem files (*.yaml) in {printable(str(folder))}")
