"""The search for defaults on rows from a formula; the commands of `make results`."""

import math
import re
from pathlib import Path

import pandas as pd
import pytest
from typer.main import get_command

from soup_nlp.bench import search as searching
from soup_nlp.bench.search import (
    DEFAULT,
    DEFAULT_SPACE,
    FAILED_LOSS,
    accepted,
    as_yaml,
    leave_one_family_out,
    pair_loss,
    parse_space,
    search,
    search_page,
)
from soup_nlp.bench.study import Cell, Item, frame_of
from soup_nlp.bench.suites import Options, list_suite
from soup_nlp.cli.main import app, main
from soup_nlp.errors import ConfigError, DataError

pytestmark = pytest.mark.slow

TEXTS = ("energy.weights.cont=log:1e-5:1e-1", "segmentation.neighbours=int:4:20")
SPACE = parse_space(TEXTS)


def fake(cell: Cell) -> dict:
    """A row whose MRE is least at cont = 1e-3 and K = 12."""
    settings = dict(o.split("=", 1) for o in cell.overrides)
    cont = float(settings.get("energy.weights.cont", "0.1"))
    k = float(settings.get("segmentation.neighbours", "20"))
    mre = 0.02 * (1 + abs(math.log10(cont) + 3) + 0.1 * abs(k - 12))
    metrics = {"solution": {"mre": mre}, "constant": {"mre": 0.4}}
    return {"metrics": metrics}


def broken(cell: Cell) -> dict:
    """No pair is measured without its files."""
    raise DataError("image is missing", where="a/0.png", found="nothing", expected="a file")


def items(*seeds: int) -> list[Item]:
    return list_suite("rendered", None, Options(width=128, seeds=seeds))


def test_parameters_are_distributions():
    assert (SPACE["energy.weights.cont"].low, SPACE["segmentation.neighbours"].high) == (1e-5, 20)
    assert [as_yaml(v) for v in (1.0, 0.012345, 1e-5, 3)] == ["1.0", "0.01235", "1e-05", "3"]
    wrong = ("a", "a=log:1", "a=log:0:1", "a=linear:2:1", "a=cube:0:1", "=log:1:2")
    for text in wrong:
        with pytest.raises(ConfigError, match="not a parameter"):
            parse_space([text])


def test_search_finds_the_minimum_and_can_be_continued(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(searching, "measure_pair", lambda cell: calls.append(cell) or fake(cell))
    path = tmp_path / "rows.jsonl"
    frame = search(SPACE, items(0)[:2], path, trials=20)
    losses = frame.groupby("variant")["loss"].mean()
    assert len(losses) == 21
    assert losses[DEFAULT] == pytest.approx(math.log(0.02 * (1 + 2 + 0.8) / 0.4))
    assert losses.min() < losses[DEFAULT] - 0.6
    before = len(calls)
    again = search(SPACE, items(0)[:2], path, trials=20)
    assert len(calls) == before
    assert again["overrides"].tolist() == frame["overrides"].tolist()
    text = search_page(frame, TEXTS, "soup-nlp bench search")
    assert f"the best is {losses.idxmin()}" in text
    assert "- `energy.weights.cont=log:1e-5:1e-1`" in text
    assert f"| {losses.idxmin()} |" in text


def test_search_rejects_unknown_parameters(tmp_path, monkeypatch):
    monkeypatch.setattr(searching, "measure_pair", fake)
    with pytest.raises(ConfigError):
        search(parse_space(["energy.wieghts=linear:0:1"]), items(0), tmp_path / "r.jsonl")
    # every default range is accepted at both ends
    search(parse_space(DEFAULT_SPACE), items(0)[:1], tmp_path / "r.jsonl", trials=0)


def test_loss_charges_failures():
    cells = [Cell(i) for i in items(0)[:3]]
    rows = [{**c.identity(), "ok": True, "code": "c", **fake(c)} for c in cells]
    rows[1]["metrics"]["solution"]["mre"] = 9.0
    rows[2] |= {"ok": False, "metrics": {}}
    loss = pair_loss(frame_of(rows)).tolist()
    assert loss[0] == pytest.approx(math.log(0.076 / 0.4))
    assert loss[1:] == [FAILED_LOSS, FAILED_LOSS]


def test_one_family_at_a_time_is_left_out():
    def frame(**trials: dict[str, float]) -> pd.DataFrame:
        lines = [
            {"variant": t, "sequence": f, "loss": math.log(mre)}
            for t, mre_of_family in trials.items()
            for f, mre in mre_of_family.items()
        ]
        return pd.DataFrame(lines)

    default = {"a": 0.1, "b": 0.1, "c": 0.1}
    narrow, wide = {"a": 0.2, "b": 0.02, "c": 0.02}, {"a": 0.08, "b": 0.09, "c": 0.104}
    left_out = leave_one_family_out(frame(t000=default, t001=narrow, t002=wide))
    assert left_out["trial"].to_dict() == dict.fromkeys("abc", "t001")
    assert left_out["change"].tolist() == pytest.approx([1.0, -0.8, -0.8])
    # the families gain together, but one of them loses more than 5 %
    assert not accepted(left_out)
    alone = leave_one_family_out(frame(t000=default, t001=wide))
    assert alone["change"].tolist() == pytest.approx([-0.2, -0.1, 0.04])
    assert accepted(alone)
    assert not accepted(leave_one_family_out(frame(t000=default, t001=default)))
    assert leave_one_family_out(frame(t000={"a": 0.1})).empty


def test_command_line_of_the_search(tmp_path, capsys, monkeypatch):
    words = ["bench", "search", "--trials", "2", "--width", "128", "--out", str(tmp_path)]
    words += ["--param", "segmentation.neighbours=int:4:19"]
    # failed rows are measured again
    for measure, code in ((broken, 1), (fake, 0)):
        monkeypatch.setattr(searching, "measure_pair", measure)
        assert main(words) == code
    out = capsys.readouterr()
    assert "image is missing, where: a/0.png" in out.err
    assert "DataError: image is missing, where: a/0.png, found: nothing\n" in out.out
    assert "--param segmentation.neighbours=int:4:19" in (tmp_path / "search.md").read_text()
    assert main([*words, "--param", "nonsense"]) == 2


def commands() -> list[str]:
    """Arguments of `soup-nlp` in the recipe that makes everything under results/."""
    text = (Path(__file__).parents[2] / "Makefile").read_text().replace("\\\n", " ")
    recipe = re.sub(r"\$\(if .*?\)\)|\$\(PAIRS\)", "--data .", text)
    return re.findall(r"\t\$\(SOUP\) (.*)", recipe)


@pytest.mark.parametrize("line", commands())
def test_every_command_of_make_results_is_understood(line):
    words = line.split()
    command = get_command(app)
    context = command.make_context("soup-nlp", words)
    while hasattr(command, "resolve_command"):
        name, command, words = command.resolve_command(context, words)
        context = command.make_context(name, words, parent=context)
    assert not words or context.params
