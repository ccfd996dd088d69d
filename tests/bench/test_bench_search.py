"""Declared studies and the search for defaults on rows from a formula."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
from typer.main import get_command

from soup_nlp.bench import search as searching
from soup_nlp.bench.accuracy_page import suite_page, write_study
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
    split,
)
from soup_nlp.bench.studies import STUDIES
from soup_nlp.bench.study import Cell, frame_of, measure_cells
from soup_nlp.bench.suites import RENDERED, Item, Options, list_suite
from soup_nlp.cli import bench_accuracy
from soup_nlp.cli.bench_all import COMMANDS
from soup_nlp.cli.main import app, main
from soup_nlp.cli.options import RowProgress
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.storage.rows import measure_all, reason

pytestmark = pytest.mark.slow

TEXTS = ("energy.weights.cont=log:1e-5:1e-1", "segmentation.neighbours=int:4:20")
SPACE = parse_space(TEXTS)


def fake(item: Item, overrides: tuple[str, ...] = (), keep: Path | None = None) -> dict:
    """A row whose MRE is least at cont = 1e-3 and K = 12."""
    given = dict(o.split("=", 1) for o in overrides)
    cont = float(given.get("energy.weights.cont", "0.1"))
    k = float(given.get("segmentation.neighbours", "20"))
    mre = 0.02 * (1 + abs(math.log10(cont) + 3) + 0.1 * abs(k - 12))
    solution = {"mre": mre, "median_relative": mre / 2, "skill": 1 - mre / 0.4}
    return {
        "metrics": {item.presets[0]: {"solution": solution, "constant": {"mre": 0.4}}},
        "energy": {"solution": {"total": 10.0}},
    }


def broken(item: Item, overrides: tuple[str, ...] = (), keep: Path | None = None) -> dict:
    """No pair is measured without its files."""
    raise DataError("image is missing", where="a/0.png", found="nothing", expected="a file")


def items(*seeds: int) -> list[Item]:
    return list(list_suite("rendered", None, Options(width=128, seeds=seeds)).items)


def of_suites(*suites: str) -> list[Item]:
    """A pair of the same name in every suite."""
    return [Item(s, s, "000027", "dis", {"kind": "motorcycle"}) for s in suites]


def test_parameters_are_distributions():
    assert (SPACE["energy.weights.cont"].low, SPACE["segmentation.neighbours"].high) == (1e-5, 20)
    assert parse_space(["a=choice:null:0.5"])["a"].choices == ("null", "0.5")
    assert [as_yaml(v) for v in (1.0, 0.012345, 1e-5, 3, ".inf")] == [
        "1.0", "0.01235", "1e-05", "3", ".inf"
    ]  # fmt: skip
    wrong = ("a", "a=log:1", "a=log:0:1", "a=linear:2:1", "a=choice:1", "a=cube:0:1", "=log:1:2")
    for text in wrong:
        with pytest.raises(ConfigError, match="not a parameter"):
            parse_space([text])
    # every default range is accepted at both ends
    searching._check(parse_space(DEFAULT_SPACE), items(0), [])


def test_search_finds_the_minimum_and_can_be_continued(tmp_path):
    path, calls = tmp_path / "rows.jsonl", []

    def counted(*args):
        calls.append(args)
        return fake(*args)

    train, validation = items(0)[:2], items(1)[:2]

    def go() -> pd.DataFrame:
        return search(SPACE, train, validation, path, measure_all, trials=40, measure=counted)

    frame = go()
    losses = frame[frame["side"] == "train"].groupby("variant")["loss"].mean()
    assert len(losses) == 41
    assert losses[DEFAULT] == pytest.approx(math.log(0.02 * (1 + 2 + 0.8) / 0.4))
    assert losses.min() < losses[DEFAULT] - 0.6
    best = losses.idxmin()
    assert {DEFAULT, best} <= set(frame.loc[frame["side"] == "validation", "variant"])
    before = len(calls)
    again = go()
    assert len(calls) == before
    assert again["overrides"].tolist() == frame["overrides"].tolist()
    text = search_page(frame, TEXTS, "soup-nlp bench search")
    assert "the gain holds" in text
    assert "- `energy.weights.cont=log:1e-5:1e-1`" in text
    assert f"| {best} |" in text


def test_search_rejects_invalid_input(tmp_path):
    path = tmp_path / "rows.jsonl"
    run = partial(search, path=path, measure_rows=measure_all, measure=fake)
    with pytest.raises(ConfigError, match="both trains and validates"):
        run(SPACE, items(0), items(0))
    with pytest.raises(ConfigError, match="no training pair"):
        run(SPACE, [], items(0))
    with pytest.raises(ConfigError):
        run(parse_space(["energy.wieghts=linear:0:1"]), items(0), [])
    # pairs of one name in two suites are different pairs
    train, validation = of_suites("kitti2012"), of_suites("kitti2015")
    frame = run(SPACE, train, validation, trials=2, finalists=1)
    assert set(frame.loc[frame["side"] == "validation", "suite"]) == {"kitti2015"}


def test_loss_charges_failures():
    cells = [Cell(i) for i in items(0)[:3]]
    rows = [{**c.identity(), "ok": True, "code": "c", **fake(c.item)} for c in cells]
    rows[1]["metrics"]["paper"]["solution"]["mre"] = 9.0
    rows[2] |= {"ok": False, "metrics": {}}
    loss = pair_loss(frame_of(rows)).tolist()
    assert loss[0] == pytest.approx(math.log(0.076 / 0.4))
    assert loss[1:] == [FAILED_LOSS, FAILED_LOSS]


def test_one_family_at_a_time_is_left_out():
    def frame(**trials: dict[str, float]) -> pd.DataFrame:
        lines = [
            {"variant": t, "sequence": f, "side": "train", "loss": math.log(mre)}
            for t, own in trials.items()
            for f, mre in own.items()
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


def test_split_keeps_scenes_apart():
    real = [
        Item("shared", n, n, f, {"kind": "motorcycle"}) for n in "abcd" for f in ("truth", "dis")
    ]
    train, validation = split([*items(0, 1, 2), *real], (0, 1), (2,))
    assert len(train) + len(validation) == 2 * 3 * len(RENDERED) + 8
    assert {i.input["seed"] for i in validation if "seed" in i.input} == {2}
    assert {i.name for i in validation if "seed" not in i.input} == {"b", "d"}
    assert not {i.name for i in train} & {i.name for i in validation}


@pytest.mark.parametrize("name", STUDIES)
def test_every_variant_of_a_study_is_a_problem(name):
    variants = STUDIES[name].variants
    problems = [items(0)[0].problem(overrides) for overrides in variants.values()]
    # no two variants are the same problem
    assert len({problem.digest() for problem in problems}) == len(variants)


def test_a_study_writes_table_and_picture(tmp_path):
    pairs = [*of_suites("kitti2012", "kitti2015"), items(0)[0]]
    cells = STUDIES["neighbours"].cells(pairs, values=["4", "12", "30"])
    path = tmp_path / "rows.jsonl"
    frame = measure_cells(cells, fake, path, measure_all)
    write_study(tmp_path, "neighbours", STUDIES["neighbours"], frame)
    text = (tmp_path / "neighbours.md").read_text()
    assert "| pair, flow | 4 | 12 | 30 |" in text
    # cont stays at 0.1: 1 + 2 + 0.1 |K - 12|
    assert "| mean of 3 | 0.0760 | 0.0600 | 0.0960 |" in text
    # pairs of one name are told apart by their suite
    assert "| kitti2012 000027, dis | 0.0760 |" in text
    assert (tmp_path / "neighbours.png").read_bytes()[:4] == b"\x89PNG"
    assert len(path.read_text().splitlines()) == 9
    rows = measure_cells(STUDIES["ablation"].cells(items(0)[:1]), broken, path, measure_all)
    write_study(tmp_path, "ablation", STUDIES["ablation"], rows)
    assert "alley_1 (published)" in (tmp_path / "ablation.md").read_text()


def test_values_are_checked_before_any_solve():
    dis = list_suite("rendered", None, Options(width=128, flows=("dis",), limit=1)).items
    for name, value in (
        *(("neighbours", v) for v in ("abc", "nan", "4.5", "")),
        ("pattern", "hexagons"),
    ):
        with pytest.raises(ConfigError):
            STUDIES[name].cells(dis, values=[value])
    with pytest.raises(ConfigError, match="give --flow truth"):
        STUDIES["flow"].cells(dis)
    with pytest.raises(ConfigError, match="no pair is left"):
        STUDIES["neighbours"].cells([])


def test_every_list_of_failures_says_which_file(capsys):
    job = Cell(items(0)[0]).job(broken)
    row = {**job.name, **job.work(), "code": "c"}
    assert "DataError: image is missing, where: a/0.png, found: nothing\n" in suite_page(
        "T", frame_of([row])
    )
    RowProgress(quiet=False)(1, 1, row)
    assert "image is missing, where: a/0.png" in capsys.readouterr().err
    assert reason({"error": ""}) == "no reason"


def test_command_line_of_studies_and_search(tmp_path, capsys, monkeypatch):
    assert main(["bench", "accuracy", "--analysis", "list"]) == 0
    assert all(name in capsys.readouterr().out for name in list(STUDIES)[:1])
    assert main(["bench", "accuracy", "--analysis", "nothing", "--out", str(tmp_path)]) == 2
    words = ["bench", "accuracy", "--analysis", "neighbours", "--values", "4,8", "--only", "orbit"]
    words += ["--width", "128", "--flow", "truth", "-q", "--preset", "lsq", "--out"]
    assert main([*words, str(tmp_path), "--folders", str(tmp_path / "f")]) == 2
    monkeypatch.setattr(bench_accuracy, "measure_pair", fake)
    assert main([*words, str(tmp_path / "a")]) == 0
    assert "one lsq scale" in capsys.readouterr().out
    monkeypatch.setattr(bench_accuracy, "measure_pair", broken)
    assert main([*words, str(tmp_path / "b")]) == 1
    for measure, code in ((fake, 0), (broken, 1)):
        kwdefaults = {**search.__kwdefaults__, "measure": measure}
        monkeypatch.setattr(search, "__kwdefaults__", kwdefaults)
        words = ["bench", "search", "--trials", "2", "--width", "128", "-q", "--out"]
        words += [str(tmp_path / str(code)), "--param", "segmentation.neighbours=int:4:19"]
        assert main(words) == code
    assert "segmentation.neighbours=int:4:19" in (tmp_path / "0" / "search.md").read_text()
    assert main([*words, "--param", "nonsense"]) == 2


@pytest.mark.parametrize("line", COMMANDS)
def test_every_command_of_bench_all_is_understood(line):
    words = line.format(out="results", data=Path.cwd()).split()
    command = get_command(app)
    context = command.make_context("soup-nlp", words)
    while hasattr(command, "resolve_command"):
        name, command, words = command.resolve_command(context, words)
        context = command.make_context(name, words, parent=context)
    assert not words or context.params


def test_bench_all_leaves_out_what_needs_data(capsys):
    assert main(["bench", "all", "--dry"]) == 0
    out = capsys.readouterr().out
    assert "--suite rendered" in out
    assert "--data" not in out
    assert main(["bench", "all", "--dry", "--data", "pairs"]) == 0
    assert "--suite shared --data pairs" in capsys.readouterr().out
