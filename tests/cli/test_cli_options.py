"""What a solve may read and write, and the surroundings of a command."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers_files import sets, write_flo, write_pair

from soup_nlp.cli.main import main
from soup_nlp.cli.options import row_progress
from soup_nlp.config.problem import load_problem
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.storage.folders import SUMS, Sums, write_sums

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts", "solves_once")]

SMALL = sets(
    "input.width=112 input.height=84 refine.from_start=true refine.rounds=1 refine.particles=4"
    " segmentation.superpixels=16 segmentation.neighbours=5 output.page=false"
)
STOPPED = sets(
    "refine.enabled=false refine.from_start=false solver.presolve_iterations=0 solver.max_iter=0"
)


def foreign(folder: Path) -> list[str]:
    """A folder with the inputs of a pair under names of result files."""
    pair = render_scene("orbit", 0, 112, 84)
    folder.mkdir()
    write_pair(folder, pair, ("frame_0", "frame_1"))
    np.savetxt(folder / "K.txt", pair.K_ref)
    (folder / "pair.yaml").write_text("input: {kind: folder, path: .}\n")
    return ["solve", str(folder / "pair.yaml"), "-q", *SMALL[4:]]


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> tuple[list[str], Path]:
    """How a pair is solved, and its result; to be copied."""
    root = tmp_path_factory.mktemp("solved")
    args = foreign(root / "pair")
    assert main([*args, "--out", str(root / "out")]) in (0, 1)
    return args, root / "out"


def test_a_folder_of_inputs_is_no_output_folder(tmp_path, refused):
    args = foreign(tmp_path / "pair")
    before = sorted(tmp_path.rglob("*"))
    assert "an input lies in the output folder" in refused(*args, "--out", tmp_path / "pair")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_result_folder_is_an_output_but_no_input(solved, tmp_path, refused):
    args, out = solved[0], shutil.copytree(solved[1], tmp_path / "out")
    # a result that is an input, too, is not overwritten
    flow = ["--flow", out / "overview.png"]
    assert "found: overview.png" in refused(*args, "--out", out, *flow)
    foreign(tmp_path / "pair")
    assert main([*args, "--out", str(out)]) in (0, 1)
    assert main(["solve", str(out / "config.yaml"), "--out", str(out), "-q"]) in (0, 1)
    # without the list the files have no known origin
    (out / SUMS).unlink()
    assert "would be overwritten" in refused(*args, "--out", out)
    assert main([*args, "--out", str(out), "--overwrite"]) in (0, 1)
    for path in (tmp_path / "pair").iterdir():
        (out / path.name).write_bytes(path.read_bytes())
    marked = tmp_path / "stopped while it was written"
    marked.mkdir()
    for path in [*(tmp_path / "pair").iterdir(), out / "depth_ref.png"]:
        (marked / path.name).write_bytes(path.read_bytes())
    write_sums(marked, Sums({}))
    for folder in (out, marked):
        said = refused("solve", folder / "pair.yaml", "--out", tmp_path / "other")
        assert "holds a result" in said
        assert f"delete {SUMS} where no solve has left files" in said
    (out / SUMS).unlink()
    said = refused("solve", out / "pair.yaml", "--out", tmp_path / "other")
    assert "found: result.h5 of a solve" in said


def test_a_picture_of_12_bits_names_its_key(tmp_path, capsys):
    args = foreign(tmp_path / "pair")
    for name in ("frame_0.png", "frame_1.png"):
        path = str(tmp_path / "pair" / name)
        cv2.imwrite(path, np.uint16(cv2.imread(path)) * 16)
    # `-q` hides the progress, but no warning
    assert main([*args, "--out", str(tmp_path / "out")]) in (0, 1)
    assert capsys.readouterr().err.count("the key white") == 1
    assert "warning: " in (tmp_path / "out" / "log.txt").read_text()
    # a warning would be an error here
    load_problem(tmp_path / "pair" / "pair.yaml", ["input.white=4095"]).load_pair()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("--help >&-", 0),
        ("list <&- >&- 2>&-", 0),
        # no space for the output
        ("list >/dev/full", 2),
    ],
)
def test_streams_that_are_closed_or_full(words, code):
    if "/dev/full" in words and not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    shell = ["sh", "-c", f'"$0" -m soup_nlp {words}', sys.executable]
    done = subprocess.run(shell, capture_output=True, text=True)
    assert done.returncode == code
    assert ("the system refuses a file" in done.stderr) == (code == 2)
    assert done.stderr.startswith("error: ") == (code == 2)
    assert "Traceback" not in done.stderr


def test_a_closed_pipe_ends_as_in_other_tools():
    end, ours = os.pipe()
    os.close(end)
    command = [sys.executable, "-m", "soup_nlp", "show", "street", "--all"]
    done = subprocess.run(command, stdout=ours, stderr=subprocess.PIPE, text=True)
    os.close(ours)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_working_folder_that_is_gone(tmp_path, monkeypatch, refused):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert "the working folder does not exist any more" in refused("solve", "orbit")


def test_a_flow_goes_with_a_problem_file(tmp_path, monkeypatch, capsys):
    flow = render_scene("orbit", 0, 112, 84).truth.flow.astype(np.float32)
    write_flo(tmp_path / "own flow.flo", flow)
    monkeypatch.chdir(tmp_path)
    args = ["solve", "orbit", "--out", "my out", "-q", "--flow", "own flow.flo", *SMALL]
    assert main(args) in (0, 1)
    assert "own flow.flo" in json.loads((tmp_path / "my out/summary.json").read_text())["flow"]
    # the command can be pasted into a shell
    assert "soup-nlp check 'my out'" in capsys.readouterr().out


def test_images_may_differ_in_size(tmp_path, capsys):
    foreign(tmp_path / "pair")
    pair = render_scene("orbit", 0, 112, 84)
    cut = str(tmp_path / "pair" / "cut.png")
    cv2.imwrite(cut, pair.image_next[:76, :104, ::-1])
    np.save(tmp_path / "cut.npy", pair.truth.depth_next[:76, :104])
    options = [str(tmp_path / "pair" / "frame_0.png"), cut]
    # the camera is a file here, as it may be in a problem file
    options += ["--intrinsics", str(tmp_path / "pair" / "K.txt")]
    options += ["--set", f"input.depth_next={tmp_path / 'cut.npy'}"]
    options += [*SMALL[4:], *STOPPED]
    assert main(["solve", "--out", str(tmp_path / "out"), *options]) == 1
    # only the next frame has a truth here
    assert "next frame" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["status"], summary["converged"]) == ("Maximum_Iterations_Exceeded", False)
    assert summary["metrics"]["solution_next"]["coverage"] > 0.5
    depth = cv2.imread(str(tmp_path / "out" / "depth_next.png"), cv2.IMREAD_UNCHANGED)
    assert depth.shape == (76, 104)


def test_rows_of_a_batch_say_how_much_time_is_left(monkeypatch, capsys):
    clock = iter([100.0, 160.0, 220.0, 280.0])
    monkeypatch.setattr("soup_nlp.cli.options.time", SimpleNamespace(monotonic=lambda: next(clock)))
    say = row_progress(quiet=False, result_of=lambda row: "fine")
    # one of four was kept, each of the others takes a minute
    for done in (2, 3, 4):
        say(done, 4, {"key": f"pair_{done}", "seconds": 60.0})
    assert capsys.readouterr().err.splitlines() == [
        "2/4  pair_2  fine  60 s, 2 min left",
        "3/4  pair_3  fine  60 s, 1 min left",
        "4/4  pair_4  fine  60 s",
    ]
