"""Studies of parts: rows in separate processes, resuming; the list of all commands."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from helpers_rows import square
from typer.main import get_command

from soup_nlp.bench.studies import Study, grid, number, run_study, setting
from soup_nlp.bench.study_parts import CUT_OFF
from soup_nlp.cli.bench_all import COMMANDS
from soup_nlp.cli.main import app, main
from soup_nlp.storage.rows import read_rows

pytestmark = pytest.mark.slow


def test_a_study_writes_its_table_and_goes_on_where_it_was(tmp_path):
    page = tmp_path / "squares.md"
    cells = {"number": setting("number"), "square": number("square", ".0f")}
    study = Study("squares", "Squares from {number}.", square, cells)
    settings = [{"number": 3}, {"number": 4, "breaks": True}]
    rows = run_study(study, tmp_path, settings)
    assert rows[0]["process"] != os.getpid()
    assert rows[0]["peak_bytes"] > 1e6
    assert page.read_text().startswith("Squares from 3.")
    assert "| 3 | 9 |" in page.read_text()
    assert "ValueError: out of numbers" in page.read_text()
    seen = []
    again = run_study(study, tmp_path, settings, lambda *args: seen.append(args))
    # what failed is tried again, nothing else
    assert again[0] == rows[0]
    assert [row["settings"]["number"] for _, _, row in seen] == [4]
    assert len(read_rows(page.with_suffix(".jsonl"))) == 3


def test_components_that_the_border_cuts_off(tmp_path):
    settings = grid(scene=["street"], seed=[1], superpixels=[40], width=[256], height=[109])
    rows = run_study(CUT_OFF, tmp_path, settings)
    assert [r["ok"] for r in rows] == [True], [r["error"] for r in rows]
    assert "street, mean" in (tmp_path / "cut_off.md").read_text()


@pytest.mark.parametrize("line", COMMANDS)
def test_every_command_of_bench_all_is_understood(line):
    words = line.format(out="results", data=Path.cwd()).split()
    command = get_command(app)
    context = command.make_context("soup-nlp", words)
    while hasattr(command, "resolve_command"):
        name, command, words = command.resolve_command(context, words)
        context = command.make_context(name, words, parent=context)


def test_bench_all_leaves_out_what_needs_data(capsys):
    assert main(["bench", "all", "--dry"]) == 0
    out = capsys.readouterr().out
    assert "--suite rendered" in out
    assert "--data" not in out
    assert main(["bench", "all", "--dry", "--data", "pairs"]) == 0
    assert "--suite shared --data pairs" in capsys.readouterr().out
