"""Many jobs, in this process and in worker processes; their rows are measured once."""

import json
import os
import platform
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest

from soup_nlp.errors import ConfigError, DataError, optional
from soup_nlp.storage.each import ONE_THREAD, append_row, attempt, each, measure_all, read_rows
from soup_nlp.storage.versions import code_version


def job(number: int) -> dict:
    """A row; 3 raises, and the processes of 4 and 5 die."""
    if number == 3:
        raise ValueError("out of numbers")
    if number == 4:
        os._exit(3)
    if number == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"square": number**2, "process": os.getpid(), "threads": os.environ["OMP_NUM_THREADS"]}


def jobs(count: int) -> dict:
    return {str(k): partial(job, k) for k in range(count)}


def test_a_row_is_plain_json():
    row = attempt(lambda: {"a": np.float64(np.nan), "b": [np.int64(3), float("inf")], "c": (1.5,)})
    assert (row["a"], row["b"], row["c"], row["ok"]) == (None, [3, None], [1.5], True)
    assert row["cpu_seconds"] >= 0 < row["peak_bytes"]
    json.dumps(row, allow_nan=False)


def test_one_worker_calls_the_jobs_here_in_their_order(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    rows = list(each(jobs(4)))
    assert [name for name, _ in rows] == ["0", "1", "2", "3"]
    assert {row["process"] for _, row in rows[:3]} == {os.getpid()}
    assert rows[3][1]["error"] == "ValueError: out of numbers"


@pytest.mark.slow
def test_a_worker_that_dies_is_one_failed_row(monkeypatch):
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    rows = dict(each(jobs(8), workers=2))
    assert [rows[str(k)].get("square") for k in (0, 1, 2, 6, 7)] == [0, 1, 4, 36, 49]
    assert os.getpid() not in {rows[str(k)]["process"] for k in (0, 1, 2, 6, 7)}
    assert {rows[str(k)]["threads"] for k in (0, 1, 2, 6, 7)} == {"1"}
    assert rows["3"]["error"] == "ValueError: out of numbers"
    assert "the process died (" in rows["4"]["error"]
    assert "died by SIGKILL" in rows["5"]["error"]


@pytest.mark.slow
def test_fresh_processes_and_their_wall_time():
    jobs = {"a": partial(job, 1), "b": partial(job, 2), "c": partial(print, sys.stdout.buffer)}
    rows = dict(each(jobs, fresh=True))
    assert rows["a"]["process"] != rows["b"]["process"]
    # what cannot be sent is a failed row
    assert not rows["c"]["ok"]
    assert "pickle" in rows["c"]["error"].lower()
    (late,) = dict(each({"a": partial(time.sleep, 60)}, fresh=True, seconds=0.5)).values()
    assert late["error"] == "wall time limit of 0.5 s reached"


INTERRUPTED = """
import os, signal, sys, time
from functools import partial
from pathlib import Path
from soup_nlp.storage.each import each
from soup_nlp.storage.folders import staged

place = Path(sys.argv[1])

def write(place, number):
    with staged(place / str(number)) as new:
        (new / "begun").touch()
        time.sleep(60 * number)
    return {"process": os.getpid()}

def begun():
    return len([*place.glob("unfinished-*/new/begun")])

# a shell lets its background jobs ignore the signal
signal.signal(signal.SIGINT, signal.default_int_handler)
rows = each({str(k): partial(write, place, k) for k in range(3)}, 2)
try:
    for name, row in rows:
        print(name, row["process"], flush=True)
        while begun() < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    rows.close()
    print("kept")
"""


@pytest.mark.slow
@pytest.mark.parametrize("script", ["script.py", "-"])
def test_after_ctrl_c_no_worker_and_no_temporary_folder_is_left(script, tmp_path, monkeypatch):
    """The script has no guard, or comes from stdin."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script.py").write_text(INTERRUPTED)
    words = [sys.executable, script, str(tmp_path / "out")]
    ended = subprocess.run(words, input=INTERRUPTED, capture_output=True, text=True, check=True)
    first, kept = ended.stdout.splitlines()
    assert (kept, ended.stderr) == ("kept", "")
    assert os.listdir("out") == ["0"]
    with pytest.raises(ProcessLookupError):
        os.kill(int(first.split()[1]), 0)


def test_a_missing_package_is_named_with_its_extra():
    with pytest.raises(ConfigError, match=r"pip install 'soup-nlp\[cluster\]'"):
        optional("no_such_package_of_ours", "cluster")


def test_a_worker_whose_parent_was_killed_before_it_began_ends():
    code = """if True:
        import os, time
        from soup_nlp.storage.system import end_with_parent
        parent = os.getpid()
        if os.fork() == 0:
            while os.getppid() == parent:
                time.sleep(0.01)
            end_with_parent(parent)
            print("alive", flush=True)
    """
    # the pipe is open until both processes have ended
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("", "")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another library than glibc")
def test_memory_that_was_freed_is_used_again():
    """The 20,000 pages of arrays that come and go ten times are not made again each time."""
    code = """
import numpy, resource
from soup_nlp.storage.system import keep_memory
keep_memory()
for k in range(20):
    if k == 10:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [numpy.ones(10**5) for _ in range(10)]
    del arrays
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    words = [sys.executable, "-c", code]
    faults = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert int(faults) < 2000


# --- rows that are kept ---------------------------------------------------------------------------


def test_rows_are_kept_and_failed_ones_measured_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    seen: list[str] = []

    def counted(scene):
        seen.append(scene)
        return {"error": "no" if scene == "sheet" else None, "number": len(seen)}

    def jobs(seed=0):
        scenes = ("orbit", "street", "sheet", "room")
        return [({"key": scene, "seed": seed}, partial(counted, scene)) for scene in scenes]

    rows = measure_all(jobs()[:2], path)
    assert [r["key"] for r in rows] == ["orbit", "street"]
    said: list[tuple[int, int]] = []
    tables: list[int] = []
    measure_all(
        jobs(),
        path,
        say=lambda done, total, row: said.append((done, total)),
        after=lambda rows: tables.append(len(rows)),
    )
    assert seen == ["orbit", "street", "sheet", "room"]
    assert said == [(3, 4), (4, 4)]
    assert tables == [3, 4]
    measure_all(jobs(), path)
    assert seen[4:] == ["sheet"]
    # another name is another row
    measure_all(jobs(1)[:1], path)
    assert seen[5:] == ["orbit"]
    append_row(path, read_rows(path)[-1] | {"number": 7})
    # of several rows of a name the last one counts
    assert [row["number"] for row in measure_all(jobs(1)[:1], path)] == [7]


def test_truncated_lines_and_rows_of_other_code_are_ignored(tmp_path):
    path = tmp_path / "rows.jsonl"
    jobs = [({"key": key}, dict) for key in ("orbit", "street")]
    measure_all(jobs, path)
    lines = path.read_text().splitlines()
    old = {**json.loads(lines[0]), "code": "older"}
    path.write_text(json.dumps(old) + "\n" + lines[1][:40])
    assert len(read_rows(path)) == 1
    rows = measure_all(jobs, path)
    assert [r["code"] for r in rows] == [code_version()] * 2
    # the new rows were not appended to the truncated line
    assert len(read_rows(path)) == 3
    with pytest.raises(DataError, match="cannot be written"):
        append_row(tmp_path / "rows.jsonl" / "x.jsonl", {})
