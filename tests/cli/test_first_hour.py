"""What a new user meets first: help that is quick, problems by name, a version, completion."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import soup_nlp
from soup_nlp.cli.main import BENCH, COMMANDS, first_line, main
from soup_nlp.config.problem import load_problem, shipped_problems
from soup_nlp.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "scipy", "cv2", "casadi", "matplotlib", "skimage")


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_help_and_version_import_no_library_of_the_method():
    code = (
        "import sys\nfrom soup_nlp.cli.main import main\n"
        "for words in (['--help'], ['--version'], ['bench', '--help']):\n    main(words)\n"
        f"print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    assert f"soup-nlp {soup_nlp.__version__}" in done.stdout
    assert "accuracy" in done.stdout


def test_a_version_has_its_changelog_and_citation():
    released = re.search(r"^## \[(\d.*?)\] - \d{4}-\d\d-\d\d$", text("CHANGELOG.md"), re.MULTILINE)
    cited = re.search(r"^version: (.*)$", text("CITATION.cff"), re.MULTILINE)
    assert released
    assert cited
    assert released[1] == cited[1] == soup_nlp.__version__


@pytest.mark.parametrize("home", [*COMMANDS.values(), *BENCH.values()])
def test_help_says_what_the_command_says_of_itself(home):
    module, _, function = home.partition(":")
    text = inspect.getdoc(getattr(import_module(f"soup_nlp.cli.{module}"), function))
    assert text.splitlines()[0] == first_line(home)


def test_completion_knows_the_commands(monkeypatch):
    words = {"_SOUP_NLP_COMPLETE": "complete_bash", "COMP_WORDS": "soup-nlp so", "COMP_CWORD": "1"}
    for key, value in words.items():
        monkeypatch.setenv(key, value)
    code = "import sys; sys.argv = ['soup-nlp']; from soup_nlp.cli.main import main; main()"
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["solve"]


def test_public_names_are_there_after_any_import():
    assert all(hasattr(soup_nlp, name) for name in soup_nlp.__all__)
    assert set(soup_nlp.__all__) <= set(dir(soup_nlp))
    # the room of the same name does not take the function's place
    import_module("soup_nlp.evaluate.scoring")
    assert callable(soup_nlp.evaluate)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        soup_nlp.nothing  # noqa: B018


def test_problems_are_found_by_name_anywhere(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert set(shipped_problems()) == {p.stem for p in (ROOT / "problems").glob("*.yaml")}
    assert load_problem("street").input.scene == "street"
    # what such a problem reads is in the user's folder, not in the package's
    assert load_problem("folder", ["input.path=mine"]).path("mine") == tmp_path / "mine"
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in shipped_problems())
    with pytest.raises(ConfigError, match="did you mean street"):
        load_problem("stret")
    (tmp_path / "street").write_text("input: {kind: motorcycle}\n")
    # a file of that name is meant first
    assert load_problem("street").input.kind == "motorcycle"
    assert main(["list", "nowhere"]) == 2


def test_the_wheel_holds_the_problems():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert '"problems" = "soup_nlp/problems"' in text
