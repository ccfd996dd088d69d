"""Analyses and the search for defaults on rows from a formula."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes

from soup_nlp.bench import analyses
from soup_nlp.bench import tuning as search_module
from soup_nlp.bench.accuracy import pair_job, row_identity
from soup_nlp.bench.accuracy_table import report
from soup_nlp.bench.analyses import ANALYSES, run_analysis, split_values
from soup_nlp.bench.analyses_measures import measure_energy
from soup_nlp.bench.analyses_report import (
    plot_energy,
    plot_flow,
    plot_variants,
    text_energy,
    text_flow,
    text_variants,
)
from soup_nlp.bench.suite_pairs import RENDERED, Item, Options
from soup_nlp.bench.suites import list_suite
from soup_nlp.bench.tables import reason
from soup_nlp.bench.tuning import (
    DEFAULT_SPACE,
    FAILED_LOSS,
    Found,
    Parameter,
    Trial,
    accepted,
    leave_one_family_out,
    loss,
    parameter,
    search,
    split,
)
from soup_nlp.bench.tuning_report import text_search
from soup_nlp.cli.main import main
from soup_nlp.cli.options import Progress
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.storage.rows import attempt

pytestmark = pytest.mark.slow

QUICK = (
    "segmentation.superpixels=40",
    "segmentation.neighbours=6",
    "solver.presolve=false",
    "solver.continuation=false",
    "solver.max_iter=5",
    "refine.rounds=1",
    "refine.particles=6",
)
SPACE = (
    parameter("energy.weights.cont=log:1e-5:1e-1"),
    parameter("segmentation.neighbours=int:4:20"),
)


def fake(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> dict:
    """A row whose MRE is least at cont = 1e-3 and K = 12."""
    given = dict(o.split("=", 1) for o in overrides)
    cont = float(given.get("energy.weights.cont", "0.1"))
    k = float(given.get("segmentation.neighbours", "20"))
    mre = 0.02 * (1 + abs(math.log10(cont) + 3) + 0.1 * abs(k - 12))
    return {
        **row_identity(item, overrides, variant),
        **{"ok": True, "error": None, "seconds": 0.0, "cpu_seconds": 0.0},
        "metrics": {
            "paper": {
                "solution": {"mre": mre, "median_relative": mre / 2, "skill": 1 - mre / 0.4},
                "constant": {"mre": 0.4},
            }
        },
        "energy": {"solution": {"total": 10.0}, "truth": {"total": 10.0}},
    }


def items(*seeds: int) -> list[Item]:
    return list(list_suite("rendered", None, Options(width=128, seeds=seeds)).items)


def test_parameters():
    p = parameter("energy.weights.cont=log:1e-4:1e-2")
    assert [float(p.at(x)) for x in (0.0, 0.5, 1.0)] == pytest.approx([1e-4, 1e-3, 1e-2])
    p = parameter("segmentation.neighbours=int:8:20")
    assert {p.at(x) for x in np.linspace(0, 1, 200)} == {str(k) for k in range(8, 21)}
    assert parameter("solver.eps=linear:0:1").at(1.0) == "1.0"
    p = parameter("flow.reweight_px=choice:null:0.5")
    assert (p.at(0.0), p.at(0.99), p.at(1.0)) == ("null", "0.5", "0.5")
    for text in (
        "a",
        "a=log:1",
        "a=log:0:1",
        "a=linear:2:1",
        "a=choice:1",
        "a=cube:0:1",
        "=log:1:2",
    ):
        with pytest.raises(ConfigError, match="not a parameter"):
            parameter(text)


def test_every_setting_of_the_default_space_is_accepted_at_both_ends():
    problem = items(0)[0]
    for p in DEFAULT_SPACE:
        for x in (0.0, 0.3, 1.0):
            problem.problem([f"{p.key}={p.at(x)}"])


def test_search_finds_the_minimum_and_can_be_continued(tmp_path):
    path = tmp_path / "rows.jsonl"
    calls = []

    def counted(*job):
        calls.append(job)
        return fake(*job)

    train, validation = items(0)[:2], items(1)[:2]
    found = search(SPACE, train, validation, path, trials=30, measure=counted)
    assert len(found.train) == 31
    assert found.train[0].overrides == ()
    assert found.train[0].loss == pytest.approx(math.log(0.02 * (1 + 2 + 0.8) / 0.4))
    assert found.best.loss < found.train[0].loss - 0.6
    chosen = dict(o.split("=") for o in found.best.overrides)
    assert 1e-4 < float(chosen["energy.weights.cont"]) < 1e-2
    assert found.validation[0].name == "t000"
    assert found.best.name in {t.name for t in found.validation}
    # later trials are nearer to the best than the first ones
    far = [np.linalg.norm(t.unit - found.best.unit) for t in found.train[1:]]
    assert np.median(far[20:]) < np.median(far[:15])
    before = len(calls)
    again = search(SPACE, train, validation, path, trials=30, measure=counted)
    assert len(calls) == before
    assert [t.overrides for t in again.train] == [t.overrides for t in found.train]
    text = text_search(found, "soup-nlp bench search")
    assert "the gain holds" in text
    assert "`energy.weights.cont` | log | 1e-5 to 1e-1" in text
    assert "t000 (default)" in text


def test_steps_beyond_the_end_of_a_range_turn_back():
    """A best trial at an end of the range is varied within the range."""
    best = Trial("t001", (), np.array([0.01, 0.99]), (fake(items(0)[0]),))
    units = np.array(
        [search_module._next(k, 24, np.zeros((12, 2)), [best], 0) for k in range(13, 25)]
    )
    assert ((units > 0) & (units < 1)).all()
    assert (units != best.unit).any(axis=0).all()
    # none is thrown to the other end
    assert np.abs(units - best.unit).max() < 0.9


def test_search_rejects_invalid_input(tmp_path):
    path = tmp_path / "rows.jsonl"
    with pytest.raises(ConfigError, match="both trains and validates"):
        search(SPACE, items(0), items(0), path, measure=fake)
    with pytest.raises(ConfigError, match="no training pair"):
        search(SPACE, [], items(0), path, measure=fake)
    with pytest.raises(ConfigError):
        search([Parameter("energy.wieghts", "linear", ("0", "1"))], items(0), [], path)


def of_suites(*suites: str, flows: tuple[str, ...] = ("dis",)) -> list[Item]:
    """A pair of the same name in every suite."""
    return [Item(s, s, "000027", f, {"kind": "motorcycle"}) for s in suites for f in flows]


def test_pairs_of_one_name_in_two_suites_may_train_and_validate(tmp_path):
    train, validation = of_suites("kitti2012"), of_suites("kitti2015")
    path = tmp_path / "rows.jsonl"
    found = search(SPACE, train, validation, path, trials=2, finalists=1, measure=fake)
    assert [t.rows[0]["suite"] for t in found.validation] == ["kitti2015"] * 2
    with pytest.raises(ConfigError, match="both trains and validates") as caught:
        search(SPACE, train, [*validation, *train], path, measure=fake)
    assert "kitti2012/000027" in str(caught.value)


def test_loss_charges_failures_and_a_minimum_far_from_the_truth():
    row = fake(items(0)[0])
    plain = loss(row)
    far = {**row, "energy": {"solution": {"total": 10.0}, "truth": {"total": 22.0}}}
    assert loss(far) == pytest.approx(plain + math.log(2.0))
    assert loss({**row, "ok": False}) == FAILED_LOSS
    worse = fake(items(0)[0], ("segmentation.neighbours=400",))
    assert plain < loss(worse) <= FAILED_LOSS
    assert Trial("t", (), np.zeros(1)).loss == math.inf


def test_one_family_at_a_time_has_no_part_in_the_choice():
    def trial(name: str, **mre: float) -> Trial:
        rows = [
            {**fake(Item("s", family, family, "dis", {})), "sequence": family} for family in mre
        ]
        for row, value in zip(rows, mre.values(), strict=True):
            row["metrics"]["paper"]["solution"]["mre"] = value
        return Trial(name, (), np.zeros(2), tuple(rows))

    default = trial("t000", a=0.1, b=0.1, c=0.1)
    narrow, wide = trial("t001", a=0.2, b=0.02, c=0.02), trial("t002", a=0.08, b=0.09, c=0.104)
    left_out = leave_one_family_out([default, narrow, wide])
    assert [(f.family, f.trial) for f in left_out] == [("a", "t001"), ("b", "t001"), ("c", "t001")]
    assert [f.change for f in left_out] == pytest.approx([1.0, -0.8, -0.8])
    # the families gain together, but one of them loses more than 5 %
    assert not accepted(left_out)
    alone = leave_one_family_out([default, wide])
    assert [f.change for f in alone] == pytest.approx([-0.2, -0.1, 0.04])
    assert accepted(alone)
    assert not accepted(leave_one_family_out([default, default]))
    assert leave_one_family_out([trial("t000", a=0.1)]) == ()
    text = text_search(Found(SPACE, (default, narrow, wide), ()), "x")
    assert "| a | t001 | +100.0% |" in text
    assert "the worst +100.0%" in text
    assert "not met" in text


def test_split_keeps_scenes_apart():
    real = [
        Item("shared", n, n, f, {"kind": "motorcycle"}) for n in "abcd" for f in ("truth", "dis")
    ]
    train, validation = split([*items(0, 1, 2), *real], (0, 1), (2,))
    assert len(train) + len(validation) == 2 * 3 * len(RENDERED) + 8
    assert {i.input["seed"] for i in validation if "seed" in i.input} == {2}
    assert {i.name for i in validation if "seed" not in i.input} == {"b", "d"}
    assert not {i.name for i in train} & {i.name for i in validation}


@pytest.mark.parametrize("name", [n for n in ANALYSES if n != "energy"])
def test_every_variant_of_an_analysis_is_a_problem(name):
    for overrides in ANALYSES[name].variants.values():
        items(0)[0].problem(overrides)


def test_an_analysis_writes_table_and_plot(tmp_path, monkeypatch):
    changed = analyses.replace(ANALYSES["neighbours"], function=fake)
    monkeypatch.setattr(analyses, "ANALYSES", {"neighbours": changed})
    listing = list_suite("rendered", None, Options(width=128, flows=("truth",), limit=2))
    path = run_analysis("neighbours", [listing], tmp_path, values=["4", "12", "30"])
    text = path.read_text()
    assert "| pair, flow | 4 | 12 | 30 |" in text
    # cont stays at 0.1: 1 + 2 + 0.1 |K - 12|
    assert "| mean of 2 | 0.0760 | 0.0600 | 0.0960 |" in text
    assert (tmp_path / "neighbours.png").read_bytes()[:4] == b"\x89PNG"
    assert len((tmp_path / "neighbours.jsonl").read_text().splitlines()) == 6
    with pytest.raises(ConfigError, match="unknown analysis"):
        run_analysis("neighbour", [listing], tmp_path)
    with pytest.raises(ConfigError, match="no pair is left"):
        run_analysis("neighbours", [], tmp_path)


def test_values_may_contain_commas_and_are_checked_before_any_solve(tmp_path):
    assert split_values("pattern", "slic,grid") == ["slic", "grid"]
    both = ["slic, image alone", "grid, image alone"]
    assert split_values("pattern", "slic, image alone,grid,image alone") == both
    assert split_values("flows", " dis, reweighted 0.5 , dis") == ["dis, reweighted 0.5", "dis"]
    assert split_values("views", "mirrored,cropped 7x5") == ["mirrored", "cropped 7x5"]
    assert split_values("neighbours", "4, 8 ,12") == ["4", "8", "12"]
    for text in ("", "4,,8", "4,"):
        with pytest.raises(ConfigError, match="value is empty"):
            split_values("neighbours", text)
    listing = list_suite("rendered", None, Options(width=128, flows=("dis",), limit=1))
    out = tmp_path / "out"
    for name, values in (
        *(("neighbours", ["8", v]) for v in ("abc", "nan", "4.5")),
        ("pattern", ["hexagons"]),
    ):
        with pytest.raises(ConfigError):
            run_analysis(name, [listing], out, values=values)
    with pytest.raises(ConfigError, match="give --flow truth"):
        run_analysis("flow", [listing], out)
    assert not out.exists()


def test_conventions_and_folders_of_an_analysis_are_not_ignored(tmp_path, monkeypatch, capsys):
    seen = []

    def scored(item, overrides, variant):
        seen.append(item.presets)
        row = fake(item, overrides, variant)
        return {**row, "metrics": {"lsq": row["metrics"]["paper"]}}

    changed = analyses.replace(ANALYSES["neighbours"], function=scored)
    monkeypatch.setattr(analyses, "ANALYSES", {**ANALYSES, "neighbours": changed})
    words = ["bench", "accuracy", "--only", "orbit", "--width", "128", "--flow", "truth", "-q"]
    words += ["--preset", "lsq", "--out", str(tmp_path / "out"), "--analysis"]
    assert main([*words, "neighbours", "--values", "8"]) == 0
    assert seen == [("lsq",)]
    assert "one lsq scale" in capsys.readouterr().out
    assert main([*words, "flows"]) == 2
    assert "no depth to score" in capsys.readouterr().err
    assert main([*words, "neighbours", "--folders", str(tmp_path / "f")]) == 2
    assert "--folders" in capsys.readouterr().err


def test_tables_list_failed_rows(tmp_path):
    jobs = [(i, (f"segmentation.neighbours={k}",), str(k)) for i in items(0)[:2] for k in (4, 8)]
    rows = [{**fake(*j), "code": "c"} for j in jobs]
    rows[1] = {**row_identity(*jobs[1]), "ok": False, "error": "out of luck", "code": "c"}
    text = text_variants("ablation", "what", rows)
    assert "out of luck" in text
    assert "alley_1 (published)" in text
    assert "-" in next(line for line in text.splitlines() if line.startswith("| street"))
    plot_variants(tmp_path / "a.png", "K", "what", rows, numeric=True)
    assert (tmp_path / "a.png").stat().st_size > 1000


def cells(text: str, column: int = 0) -> list[str]:
    return [line.split(" | ")[column].strip("| ") for line in text.splitlines() if "| " in line]


def test_pairs_of_one_name_in_two_suites_are_told_apart(tmp_path, monkeypatch):
    def rows_of(made: list[Item], *variants: str) -> list[dict]:
        jobs = [(i, (f"segmentation.neighbours={v}",), v) for i in made for v in variants]
        return [{**fake(*j), "code": "c"} for j in jobs]

    both = rows_of(of_suites("kitti2012", "kitti2015"), "4", "12")
    text = text_variants("neighbours", "what", both)
    for suite in ("kitti2012", "kitti2015"):
        assert f"| {suite} 000027, dis | 0.0760 | 0.0600 |" in text
    assert "mean of 2" in text
    # where there is no other of that name the suite is not said
    alone = text_variants("neighbours", "what", rows_of(of_suites("kitti2012"), "4", "12"))
    assert "| 000027, dis | 0.0760 | 0.0600 |" in alone
    error = {"mean": 1.0, "weighted_mean": 1.0, "median": 1.0, "over_3px": 0.0, "used": 1.0}
    flows = [
        {**row, "flow_error": {**error, "weighted_mean": float(k)}} for k, row in enumerate(both)
    ]
    names = cells(text_flow("flows", "what", flows))
    assert names.count("kitti2012 000027") == names.count("kitti2015 000027") == 2
    drawn, bar = [], Axes.bar

    def seen(self, x, height, *args, **kwargs):
        drawn.append(list(height))
        return bar(self, x, height, *args, **kwargs)

    monkeypatch.setattr(Axes, "bar", seen)
    plot_flow(tmp_path / "f.png", flows)
    assert drawn == [[0.0, 2.0], [1.0, 3.0]]


def test_energy_at_the_truth(tmp_path):
    raw = {"kind": "scene", "scene": "orbit", "seed": 0, "width": 128, "height": 64}
    item = Item("rendered", "orbit", "orbit", "truth", raw)
    # the presolve lowers the energy where five iterations of Ipopt alone need not
    quick = tuple(o for o in QUICK if o != "solver.presolve=false")
    job = pair_job(item, quick, measure=measure_energy)
    row = {**job.name, **job.work()}
    assert row["ok"], row["error"]
    json.dumps(row, allow_nan=False)
    energy = {k: v["total"] for k, v in row["energy"].items()}
    assert set(energy) == {"start", "solution", "truth", "NLP from truth", "refined from truth"}
    tol = 1 + 1e-9
    assert energy["solution"] <= tol * energy["start"]
    assert energy["NLP from truth"] <= tol * energy["truth"]
    assert energy["refined from truth"] <= tol * energy["NLP from truth"]
    text = text_energy("energy", "what", [{**row, "code": "c"}])
    assert f"{energy['truth'] / energy['solution']:.3f}" in text
    plot_energy(tmp_path / "e.png", [row, row])
    assert (tmp_path / "e.png").stat().st_size > 1000
    # a pair without motions says so
    bare = Item("shared", "tum", "t", "dis", {"kind": "tum", "path": str(tmp_path)})
    assert not attempt(lambda: measure_energy(bare))["ok"]


def test_errors_of_flow_sources(tmp_path):
    listing = list_suite("rendered", None, Options(width=160, flows=("truth",), limit=2))
    path = run_analysis("flows", [listing], tmp_path, ("segmentation.superpixels=30",))
    text = path.read_text()
    rows = [json.loads(line) for line in (tmp_path / "flows.jsonl").read_text().splitlines()]
    error = {(r["pair"], r["variant"]): r["flow_error"]["weighted_mean"] for r in rows if r["ok"]}
    for pair in {p for p, _ in error}:
        assert 0 < error[pair, "dis, reweighted 0.25"] < error[pair, "dis"] < 1.0
    assert "Mean of 2 pairs" in text
    # without the contributed modules the source is a row that failed
    assert "rlof" in text
    assert (tmp_path / "flows.png").stat().st_size > 1000


def broken(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> dict:
    """No pair is measured without its files."""
    raise DataError("image is missing", where="a/0.png", found="nothing", expected="a file")


def test_every_list_of_failures_says_which_file(capsys):
    job = pair_job(items(0)[0], measure=broken)
    row = {**job.name, **job.work(), "code": "c"}
    for text in (report("T", [row]), text_variants("x", "w", [row]), text_flow("x", "w", [row])):
        assert "DataError: image is missing, where: a/0.png, found: nothing\n" in text
    Progress(quiet=False)(1, 1, row)
    assert "image is missing, where: a/0.png" in capsys.readouterr().err
    assert reason({"error": ""}) == "no reason"


def test_failed_pairs_of_analyses_and_search_end_with_1(tmp_path, monkeypatch, capsys):
    def measured_by(function):
        changed = analyses.replace(ANALYSES["neighbours"], function=function)
        monkeypatch.setattr(analyses, "ANALYSES", {"neighbours": changed})

    measured_by(fake)
    words = ["bench", "accuracy", "--analysis", "neighbours", "--values", "4,8", "--only", "orbit"]
    words += ["--width", "128", "--flow", "truth", "-q", "--out"]
    assert main([*words, str(tmp_path / "a")]) == 0
    measured_by(broken)
    assert main([*words, str(tmp_path / "b")]) == 1
    kwdefaults = {**search_module.search.__kwdefaults__, "measure": broken}
    monkeypatch.setattr(search_module.search, "__kwdefaults__", kwdefaults)
    words = ["bench", "search", "--trials", "1", "--width", "128", "-q", "--out", str(tmp_path)]
    assert main([*words, "--param", "segmentation.neighbours=int:4:19"]) == 1


def test_command_line_of_analyses_and_search(tmp_path, capsys, monkeypatch):
    assert main(["bench", "accuracy", "--analysis", "list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ANALYSES)
    assert main(["bench", "accuracy", "--analysis", "nothing", "--out", str(tmp_path)]) == 2
    from soup_nlp.bench import tuning as module

    kwdefaults = {**module.search.__kwdefaults__, "measure": fake}
    monkeypatch.setattr(module.search, "__kwdefaults__", kwdefaults)
    words = ["bench", "search", "--trials", "4", "--width", "128", "--out", str(tmp_path)]
    assert main([*words, "--param", "segmentation.neighbours=int:4:19", "-q"]) == 0
    text = (tmp_path / "search.md").read_text()
    assert "--param 'segmentation.neighbours=int:4:19'" in text
    assert Path(tmp_path / "search.jsonl").is_file()
    assert main([*words, "--param", "nonsense"]) == 2
