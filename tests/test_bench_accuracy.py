"""Accuracy of pairs: rows that have every number, that survive, and that are as asked."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from soup_nlp.bench.accuracy import (
    Job,
    clean,
    head,
    input_hash,
    measure,
    settings_hash,
)
from soup_nlp.bench.accuracy_runner import Where, measure_all, read_rows
from soup_nlp.bench.accuracy_table import report
from soup_nlp.bench.rivals import METHODS
from soup_nlp.bench.suites import SUITES
from soup_nlp.bench.suites_pairs import Item
from soup_nlp.cli.main import accuracy as cli_accuracy
from soup_nlp.cli.main import main
from soup_nlp.config.problem import make_problem
from soup_nlp.errors import ConfigError
from soup_nlp.storage.versions import code_version

QUICK = (
    "segmentation.superpixels=40",
    "segmentation.neighbours=6",
    "solver.presolve=false",
    "solver.max_iter=5",
    "refine.rounds=1",
    "refine.particles=6",
)
K = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])


def item(scene: str = "orbit", flow: str = "truth", seed: int = 0) -> Item:
    raw = {"kind": "scene", "scene": scene, "seed": seed, "width": 128, "height": 64}
    return Item("rendered", scene, f"{scene}-{seed}", flow, raw, ("paper", "best"))


@pytest.fixture(scope="module")
def orbit_row():
    return measure(Job(item(), QUICK))


def test_a_row_has_every_number(orbit_row):
    row = orbit_row
    assert row["ok"], row["error"]
    json.dumps(row, allow_nan=False)
    for convention in ("paper", "best"):
        table = row["metrics"][convention]
        assert set(table) == set(METHODS)
        assert table["constant"]["skill"] == 0.0
        assert table["floor"]["mre"] <= table["plane"]["mre"] <= table["constant"]["mre"]
        # one rigid motion with the true flow is exact on a scene of one component
        assert table["rigid"]["mre"] < 1e-3
        assert table["floor"]["mre"] <= table["solution"]["mre"]
        if convention == "best":
            assert table["plane"]["mre"] <= table["constant"]["mre"]
    for method in ("solution", "start", "plane"):
        best = row["metrics"]["best"][method]["mre"]
        assert best <= row["metrics"]["paper"][method]["mre"] + 1e-12
    assert row["flow_error"]["mean"] < 1e-5
    assert row["scene_flow"]["coverage"] == 1.0
    assert set(row["energy"]) == {"start", "nlp", "solution", "truth"}


def test_a_pair_that_fails_is_a_row():
    row = measure(Job(item(), (*QUICK, "segmentation.neighbours=99")))
    assert not row["ok"]
    assert "K-NN" in row["error"]
    wrong = measure(Job(item(), ("segmentation.superpixel=3",)))
    assert not wrong["ok"]
    assert wrong["settings"] == "wrong"
    text = report("T", [{**row, "code": "c"}])
    assert "0 of 1 pairs measured" in text
    assert "K-NN" in text


def test_a_pair_without_truth_is_a_row_that_failed(tmp_path):
    """So it is measured once the truth is there; it is not solved before."""
    for k in (0, 1):
        cv2.imwrite(str(tmp_path / f"frame_{k}.png"), np.zeros((48, 64, 3), np.uint8))
    np.savetxt(tmp_path / "K.txt", K)
    raw = {"kind": "folder", "path": str(tmp_path)}
    needs = (tmp_path / "frame_0.png",)
    pair = Item("kinect_paper", "s", "p", "dis", raw, ("eigen80", "paper"), needs)
    row = measure(Job(pair, QUICK))
    assert not row["ok"]
    assert "pair has no true depth" in row["error"]
    assert SUITES["kinect_paper"].layout in row["error"]
    assert SUITES["kinect_paper"].source in row["error"]


def test_settings_hash_is_the_same_on_every_pair():
    a = make_problem({"input": {"kind": "motorcycle"}, "name": "a"})
    b = item().problem(["flow.source=dis"])
    assert settings_hash(a) == settings_hash(b)
    assert settings_hash(a) != settings_hash(item().problem(["flow.source=truth"]))
    assert settings_hash(a) != settings_hash(item().problem(["energy.weights.cont=9.0"]))


def test_input_hash_is_of_the_frames_not_of_their_place():
    def sintel_at(root: str, *overrides: str) -> Job:
        raw = {"kind": "sintel", "root": root, "scene": "alley_1", "frame": 2}
        return Job(Item("sintel", "alley_1", "alley_1-0002", "dis", raw), overrides)

    here, final = sintel_at("/a"), sintel_at("/a", "input.render=final")
    assert head(here) == head(sintel_at("/b"))
    assert head(here)["settings"] == head(final)["settings"]
    assert head(here)["input"] != head(final)["input"]
    first, second = (
        Item("vkitti", "w", "w", "dis", {"kind": k, "root": "r", "scene": s, "frame": 1}).problem()
        for k, s in (("vkitti1", "0001"), ("vkitti2", "Scene01"))
    )
    assert input_hash(first) != input_hash(second)


def test_clean_leaves_plain_json():
    given = {"a": np.float64(np.nan), "b": [np.int64(3), float("inf")], "c": (1.5, None, "x")}
    assert clean(given) == {"a": None, "b": [3, None], "c": [1.5, None, "x"]}


def fake(job: Job) -> dict:
    """A row without a solve; the process of a pair named "dead" dies."""
    if job.item.name.startswith("room") and "dies" in job.overrides:
        os._exit(3)
    ok = job.item.sequence != "sheet"
    return {**head(job), "ok": ok, "error": None if ok else "no", "seconds": 0.0}


def fake_jobs(*overrides: str) -> list[Job]:
    return [Job(item(scene), overrides) for scene in ("orbit", "street", "sheet", "room")]


def test_rows_are_kept_and_what_failed_is_tried_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    seen: list[str] = []

    def counted(job):
        seen.append(job.item.sequence)
        return fake(job)

    rows = measure_all(fake_jobs()[:2], path, function=counted)
    assert [r["sequence"] for r in rows] == ["orbit", "street"]
    said: list[tuple[int, int]] = []
    rows = measure_all(
        fake_jobs(), path, function=counted, say=lambda done, total, row: said.append((done, total))
    )
    assert seen == ["orbit", "street", "sheet", "room"]
    assert said == [(3, 4), (4, 4)]
    measure_all(fake_jobs(), path, function=counted)
    assert seen[4:] == ["sheet"]
    # other settings are other rows, and so is another input
    measure_all(fake_jobs("seed=1")[:1], path, function=counted)
    assert seen[5:] == ["orbit"]
    assert len(read_rows(path)) == 5
    measure_all(fake_jobs("input.seed=1")[:1], path, function=counted)
    assert seen[6:] == ["orbit"]
    assert len(read_rows(path)) == 6
    with pytest.raises(ConfigError, match="twice"):
        measure_all([*fake_jobs(), *fake_jobs()], path, function=counted)


def test_a_stored_row_serves_where_it_has_the_conventions_and_the_folder(tmp_path):
    path, seen = tmp_path / "rows.jsonl", []

    def scored(job):
        seen.append(job.item.presets)
        tables = {name: {"solution": {"mre": 0.1}} for name in job.item.presets}
        return {**fake(job), "metrics": tables}

    def asked(*presets: str, folder: Path | None = None) -> dict:
        job = Job(item().scored_by(presets), folder=folder)
        return measure_all([job], path, function=scored)[0]

    asked("paper", "best")
    row = asked("best")
    assert seen == [("paper", "best")]
    assert row["presets"] == list(row["metrics"]) == ["best"]
    asked("lsq", "paper", "best")
    assert seen[1:] == [("lsq", "paper", "best")]
    assert list(asked("best", "lsq")["metrics"]) == ["best", "lsq"]
    # a folder that is not there is made, one that is there is not made again
    kept = tmp_path / "kept"
    asked("paper", folder=kept)
    assert len(seen) == 3
    kept.mkdir()
    (kept / "summary.json").touch()
    asked("paper", folder=kept)
    assert len(seen) == 3


def test_scene_flow_keeps_the_scale_of_its_convention(tmp_path):
    def scored(job):
        tables = {name: {"solution": {"mre": 0.1}} for name in job.item.presets}
        seen.append(job)
        return {**fake(job), "metrics": tables, "scene_flow": {"mean": 0.1}}

    seen: list[Job] = []
    for presets in (("paper", "best"), ("paper",), ("best",)):
        measure_all([Job(item().scored_by(presets))], tmp_path / "rows.jsonl", function=scored)
    assert [job.item.presets for job in seen] == [("paper", "best"), ("best",)]


def test_a_line_that_was_cut_off_and_another_code_do_not_count(tmp_path):
    path = tmp_path / "rows.jsonl"
    measure_all(fake_jobs()[:2], path, function=fake)
    lines = path.read_text().splitlines()
    old = {**json.loads(lines[0]), "code": "older"}
    path.write_text(json.dumps(old) + "\n" + lines[1][:40])
    seen: list[str] = []

    def counted(job):
        seen.append(job.item.sequence)
        return fake(job)

    rows = measure_all(fake_jobs()[:2], path, function=counted, any_code=True)
    assert seen == ["street"]
    assert [r["code"] for r in rows] == ["older", code_version()]
    measure_all(fake_jobs()[:2], path, function=counted)
    assert seen == ["street", "orbit"]
    assert len(read_rows(path)) == 3


def test_parallel_processes_and_one_that_dies(tmp_path):
    pytest.importorskip("joblib", reason="joblib is not installed (extra bench)")
    from soup_nlp.bench import accuracy_runner

    # the children must find this module's function
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    )
    jobs = fake_jobs("seed=2")
    rows = measure_all(jobs, tmp_path / "a.jsonl", Where(workers=2), function=fake)
    assert [r["sequence"] for r in rows] == ["orbit", "street", "sheet", "room"]
    assert [r["ok"] for r in rows] == [True, True, False, True]
    jobs = fake_jobs("dies")
    rows = measure_all(jobs, tmp_path / "b.jsonl", Where(workers=2), function=fake)
    assert [r["ok"] for r in rows] == [True, True, False, False]
    assert "process died" in rows[3]["error"]
    assert accuracy_runner.read_rows(tmp_path / "b.jsonl")


@pytest.mark.filterwarnings("ignore")
def test_a_local_dask_cluster(tmp_path):
    distributed = pytest.importorskip("distributed", reason="Dask is not installed (extra dask)")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address
        rows = measure_all(fake_jobs(), tmp_path / "rows.jsonl", Where(dask=address), function=fake)
    assert [r["ok"] for r in rows] == [True, True, False, True]
    assert len(read_rows(tmp_path / "rows.jsonl")) == 4


def test_result_folders_are_the_same_for_workers_elsewhere(tmp_path, monkeypatch):
    asked: list[Path | None] = []

    def stored(jobs, *_, **__):
        asked.extend(job.folder for job in jobs)
        return []

    monkeypatch.setattr(cli_accuracy, "measure_all", stored)
    monkeypatch.chdir(tmp_path)
    words = ["bench", "accuracy", "--suite", "rendered", "--only", "orbit", "--flow", "truth"]
    assert main([*words, "-q", "--folders", "runs", "--out", "."]) == 0
    (folder,) = asked
    assert folder.is_relative_to(tmp_path / "runs")


def test_command_line(tmp_path, capsys):
    words = ["bench", "accuracy", "--suite", "rendered", "--only", "orbit", "--flow", "truth"]
    words += ["--width", "128", "--out", str(tmp_path), "--folders", str(tmp_path / "runs")]
    words += [w for o in QUICK for w in ("--set", o)]
    assert main(words) == 0
    out = capsys.readouterr()
    assert "1/1  rendered/orbit-s0-128x54/truth  MRE 0." in out.err
    assert "one median scale per image, no cap" in out.out
    assert (tmp_path / "rendered.md").read_text() in out.out
    assert (tmp_path / "runs" / "rendered" / "orbit-s0-128x54" / "truth" / "summary.json").is_file()
    # nothing is measured twice
    before = (tmp_path / "rendered.jsonl").read_text()
    assert main([*words, "-q"]) == 0
    assert capsys.readouterr().err == ""
    assert (tmp_path / "rendered.jsonl").read_text() == before
    assert main(["bench", "accuracy"]) == 2
    assert main(["bench", "accuracy", "--suite", "imagenet"]) == 2
    assert main([*words, "--preset", "eigen"]) == 2
    assert main(["bench", "accuracy", "--suite", "rendered", "--seeds", "a"]) == 2
