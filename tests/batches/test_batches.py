"""Many pairs: their sources, table, page, resumption, two runs in one folder, a cluster."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers_files import sets, write_pair
from kill_table import start

import soup_nlp
from soup_nlp.batches.run import _claimed, batch, interval, page, table
from soup_nlp.batches.sources import problems_of
from soup_nlp.cli.main import main
from soup_nlp.config.problem import make_problem
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.storage.each import each, read_rows

pytestmark = pytest.mark.usefixtures("simple_starts")

TINY = [
    *("segmentation.superpixels=12", "segmentation.neighbours=4", "energy.pixel_samples=4"),
    # refining the start takes less time than Ipopt
    *("refine.from_start=true", "refine.rounds=1", "refine.particles=4", "output.page=false"),
]
TINY_SET = sets(" ".join(TINY))


def write_folder(folder: Path, scene: str, seed: int = 0) -> None:
    pair = render_scene(scene, seed, 96, 64)
    folder.mkdir(parents=True)
    write_pair(folder, pair, ("frame_0", "frame_1"))
    np.savetxt(folder / "K.txt", pair.K_ref)
    np.save(folder / "depth.npy", pair.truth.depth_ref)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory) -> Path:
    """A folder of three pairs, one of which is damaged."""
    root = tmp_path_factory.mktemp("pairs")
    for k, scene in enumerate(("orbit", "street")):
        write_folder(root / f"{k}_{scene}", scene)
    (root / "2_bad").mkdir()
    for name in ("frame_0.png", "frame_1.png", "K.txt"):
        (root / "2_bad" / name).write_text("not an image")
    return root


def test_a_folder_a_pattern_and_a_list_name_the_same_pairs(pairs):
    names = ["0_orbit", "1_street", "2_bad"]
    assert list(problems_of(pairs)) == names
    assert list(problems_of(f"{pairs}/[01]*")) == names[:2]
    listed = problems_of([pairs / "0_orbit", str(pairs / "0_orbit")], ["seed=7"])
    # a second pair of a name has a folder of its own
    assert [(k, p.name, p.seed) for k, p in listed.items()] == [
        ("0_orbit", "0_orbit", 7), ("0_orbit-2", "0_orbit-2", 7),
    ]  # fmt: skip
    raw = {"input": {"kind": "scene", "scene": "street"}}
    assert list(problems_of([raw, make_problem({**raw, "name": "other"})]))[1] == "other"
    for wrong, error in ((pairs / "0_orbit" / "nothing*", DataError), ([{}], ConfigError)):
        with pytest.raises(error):
            problems_of(wrong)


def test_a_table_has_keys_of_the_problem_as_columns(pairs, tmp_path):
    rows = [
        "name,ref,next,intrinsics,segmentation.superpixels,depth_prior.kind",
        f"first,{pairs}/0_orbit/frame_0.png,{pairs}/0_orbit/frame_1.png,{pairs}/0_orbit/K.txt,30,",
        f",{pairs}/1_street/frame_0.png,{pairs}/1_street/frame_1.png,,,",
    ]
    path = tmp_path / "pairs.csv"
    path.write_text("\n".join(rows) + "\n")
    first, second = problems_of(path, ["segmentation.neighbours=5"]).values()
    assert (first.name, first.segmentation.superpixels, first.segmentation.neighbours) == (
        "first", 30, 5,
    )  # fmt: skip
    assert second.name == "1_street-frame_0"
    assert second.segmentation.superpixels != 30
    assert first.load_pair().size == (64, 96)
    for text, said in (
        ("a,b\n1,2\n", "no pairs"),
        ("ref,next\n1.png\n", "names no pair"),
        ("ref,next\n1.png,2.png,3\n", "more cells"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=said):
            problems_of(path)


def test_a_data_set_has_every_pair_whose_frames_are_there(tmp_path):
    folder = tmp_path / "training" / "image_2"
    folder.mkdir(parents=True)
    for name in ("000001_10", "000001_11", "000004_10"):
        (folder / f"{name}.png").touch()
    (problem,) = problems_of(f"kitti2015:{tmp_path}").values()
    assert (problem.name, problem.input.index) == ("000001", "000001")


def test_the_same_input_has_the_same_contents(pairs, tmp_path):
    place = Path(shutil.copytree(pairs / "0_orbit", tmp_path / "moved"))

    def of_folder(folder: Path, **keys: object) -> str:
        raw = {"input": {"kind": "folder", "path": str(folder)}, **keys}
        return make_problem(raw).identity()

    before = of_folder(place)
    assert before == of_folder(pairs / "0_orbit", name="other")
    assert before != of_folder(place, seed=3)
    # other bytes under the same name
    shutil.copy(place / "frame_0.png", place / "frame_1.png")
    assert of_folder(place) != before

    def files(**keys: object) -> str:
        names = {"ref": "frame_0.png", "next": "frame_1.png", "intrinsics": "K.txt"}
        raw = {"input": {"kind": "files", **names}, "base": str(place), **keys}
        return make_problem(raw).identity()

    np.save(place / "flow.npy", np.zeros((64, 96, 2)))
    first = files()
    for section, name in (("flow", "flow.npy"), ("depth_prior", "depth.npy")):
        keys = {section: {"source": name}}
        given = files(**keys)
        np.save(place / name, np.load(place / name) + 1)
        assert len({first, given, files(**keys)}) == 3
    assert files() == first
    np.savetxt(place / "K.txt", 1.1 * np.loadtxt(place / "K.txt"))
    assert files() != first
    (place / "K.txt").unlink()
    with pytest.raises(DataError, match=r"K\.txt"):
        files()


def rows_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "table.csv").open() as file:
        return {row["pair"]: row for row in csv.DictReader(file)}


@pytest.mark.slow
def test_a_batch_keeps_what_is_finished(pairs, tmp_path, capsys, request):
    root, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(pairs, root)
    words = ["batch", str(root), "-o", str(out), "--workers", "2", *TINY_SET]
    assert main(words) == 1
    rows = rows_of(out)
    assert [row["exit_code"] for row in rows.values()][2] == "2"
    assert "image" in rows["2_bad"]["reason"]
    assert 0 < float(rows["0_orbit"]["mre"]) < float(rows["0_orbit"]["constant"])
    result = soup_nlp.load(out / "pairs" / "0_orbit")
    assert result.summary["metrics"]["solution"]["mre"] == float(rows["0_orbit"]["mre"])
    text = (out / "index.html").read_text()
    assert 'href="pairs/0_orbit/report.html"' in text
    assert "3 of 3 pairs, 1 failed; MRE mean" in text
    assert "3 of 3 pairs, 1 failed" in capsys.readouterr().out
    # what is finished is kept; what was replaced under its name, or repaired, is solved
    solved = len(read_rows(out / "pairs.jsonl"))
    request.getfixturevalue("one_process")
    assert main(words) == 1
    assert len(read_rows(out / "pairs.jsonl")) == solved == 2
    for name in ("frame_0.png", "frame_1.png", "K.txt"):
        shutil.copy(root / "0_orbit" / name, root / "2_bad" / name)
    shutil.copy(root / "1_street" / "frame_0.png", root / "1_street" / "frame_1.png")
    main(words)
    new = [row["key"] for row in read_rows(out / "pairs.jsonl")[solved:]]
    assert sorted(new) == ["1_street", "2_bad"]
    assert rows_of(out)["0_orbit"] == rows["0_orbit"]


@pytest.fixture(scope="module")
def four(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("four")
    for k in range(4):
        write_folder(root / f"orbit_{k}", "orbit", k)
    return root


@pytest.mark.slow
def test_a_killed_run_goes_on_and_two_runs_solve_no_pair_twice(four, tmp_path, request):
    out = tmp_path / "out"
    command = ["batch", str(four), "-o", str(out), "-q", *TINY_SET]
    run = start(command)
    while len(read_rows(out / "pairs.jsonl")) < 1:
        time.sleep(0.05)
    run.kill()
    run.join()
    kept = read_rows(out / "pairs.jsonl")
    # as if it had been killed between the row and its mark
    (out / "pairs" / f"{kept[0]['key']}.claim").write_text(f"{os.uname().nodename} {run.pid} 1")
    request.getfixturevalue("one_process")
    runs = [start(command) for _ in range(2)]
    for run in runs:
        run.join()
    assert [run.exitcode for run in runs] == [0, 0]
    rows = read_rows(out / "pairs.jsonl")
    assert rows[: len(kept)] == kept
    assert sorted(row["key"] for row in rows) == [f"orbit_{k}" for k in range(4)]
    assert not list((out / "pairs").glob("*.claim"))
    assert len(rows_of(out)) == 4
    # and in Python
    done = batch(four, out, overrides=TINY)
    assert done.good
    assert len(done.rows) == 4
    assert read_rows(out / "pairs.jsonl") == rows


def test_a_pair_of_a_run_that_lives_is_not_taken(tmp_path):
    mark = tmp_path / "pairs" / "a.claim"
    assert _claimed(mark, f"elsewhere {os.getpid()} 1")
    assert not _claimed(mark, "here 1 2")
    # made, but not yet written
    mark.write_text("")
    assert not _claimed(mark, "here 1 2")
    # without a sign of life, or if its process ended on this machine, it is free
    os.utime(mark, (0, 0))
    assert _claimed(mark, "here 1 2")
    mark.write_text(f"{os.uname().nodename} 4194305 1")
    assert _claimed(mark, "here 1 2")


def test_a_table_and_a_page_of_rows():
    good = {"pair": "a", "exit_code": 0, "reason": "solved", "mre": 0.1, "peak_bytes": 2**21}
    bad = {"pair": "<b>", "ok": False, "error": "DataError: damaged\n  where: x.png"}
    assert "a,0,solved,0.1," in table([good, bad])
    assert '<b>,2,"DataError: damaged, where: x.png"' in table([good, bad])
    text = page([good, bad], 3)
    assert "2 of 3 pairs, 1 failed; MRE mean 0.1000 (0.1000 to 0.1000)" in text
    assert "&lt;b&gt;" in text
    assert "<b>" not in text
    mean, low, high = interval(np.arange(100.0), np.mean)
    assert low < mean == 49.5 < high
    # 1.96 standard errors
    assert (high - low) / 2 == pytest.approx(1.96 * np.arange(100).std() / 10, rel=0.1)


QUIET: dict[str, int] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


@pytest.fixture
def cluster(tmp_path):
    """Address, scheduler and two workers of a cluster on the loopback address."""
    pytest.importorskip("distributed")
    place = tmp_path / "scheduler.json"
    words = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
    words += ["--port", "0", "--no-dashboard", "--scheduler-file", str(place)]
    started = [subprocess.Popen(words, cwd=tmp_path, **QUIET)]
    try:
        while not place.is_file() or not place.stat().st_size:
            time.sleep(0.1)
        address = json.loads(place.read_text())["address"]
        # the second one as docs/cluster.md starts it: a nanny's worker is a daemon
        for k, nanny in enumerate(("--no-nanny", "--nanny")):
            words = [sys.executable, "-m", "distributed.cli.dask_worker", address, nanny]
            words += ["--nthreads", "1", "--no-dashboard", "--local-directory", f"{tmp_path}/{k}"]
            started.append(subprocess.Popen(words, cwd=tmp_path, **QUIET))
        yield address, started
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_survives_the_loss_of_a_worker_but_not_of_its_scheduler(four, tmp_path, cluster):
    address, started = cluster
    killed = []

    def kill_one(done: int, total: int, row: dict) -> None:
        if not killed:
            killed.append(started[1].pid)
            os.kill(started[1].pid, signal.SIGKILL)

    done = batch(four, tmp_path / "out", overrides=TINY, cluster=address, say=kill_one)
    assert done.good
    assert len(killed) == 1
    assert len(rows_of(tmp_path / "out")) == 4

    # pickled by value: the workers do not know this module
    def later() -> dict[str, int]:
        time.sleep(0.5)
        return {}

    rows = each({str(k): later for k in range(8)}, cluster=address)
    assert next(rows)[1]["ok"]
    started[0].kill()
    with pytest.raises(DataError, match="scheduler of the cluster is lost"):
        list(rows)
