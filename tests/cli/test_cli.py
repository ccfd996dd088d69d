"""The command line: exit codes, messages, files, rejection of bad input."""

import json
import os
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import trimesh
from helpers_files import sets, write_flo, write_pair

from soup_nlp.cli.main import main
from soup_nlp.data.scenes.catalogue import render_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

SMALL = sets(
    "input.width=144 input.height=96 segmentation.superpixels=25 segmentation.neighbours=6"
    " flow.source=truth solver.presolve_iterations=60"
)
FILES = [
    "config.yaml", "result.h5", "summary.json", "log.txt", "ipopt.log", "depth_ref.png",
    "depth_next.png", "depth_ref_colour.png", "overview.png",
    "trajectory.tum", "report.html", "points_ref.ply", "points_next.ply",
]  # fmt: skip


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("solved")
    assert main(["solve", "orbit", "--out", str(out), *SMALL]) == 0
    return out


def test_a_solve_writes_every_file(solved):
    for name in FILES:
        assert (solved / name).stat().st_size > 0, name
    assert (solved / "log.txt").read_text().splitlines()[-1].startswith("exit code   0: ")
    summary = json.loads((solved / "summary.json").read_text())
    assert summary["converged"]
    assert summary["energy"]["nlp"]["total"] < summary["energy"]["start"]["total"]
    refined = summary["refinement"]
    assert refined["end"]["total"] < refined["begin"]["total"]
    assert summary["residuals"]["so3"] < 1e-8
    assert summary["residuals"]["normal"] < 1e-8
    assert summary["metrics"]["solution"]["mre"] < summary["metrics"]["constant"]["mre"]
    cloud = trimesh.load(solved / "points_ref.ply")
    # without pixels that are hidden or at jumps of the depth
    assert 144 * 96 > len(cloud.vertices) == len(cloud.colors) > 0.7 * 144 * 96
    with h5py.File(solved / "result.h5") as file:
        assert file["solution/R"].attrs["units"] == "1"
        assert file["depth/ref"].shape == (96, 144)
        assert "lam_g_so3" in file["multipliers"]
        assert "config" in file.attrs
    depth = cv2.imread(str(solved / "depth_ref.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert main(["check", str(solved)]) == 0


def test_evaluate_scores_against_a_file(solved, tmp_path, capsys, refused):
    with h5py.File(solved / "result.h5") as file:
        truth = 7.0 * file["depth/ref"][:]
    mask = np.zeros(truth.shape, np.uint8)
    mask[:, :9] = 255
    # what moves is twice as far as the solution says
    np.save(tmp_path / "gt.npy", truth * np.where(mask, 2, 1))
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    call = ["evaluate", str(solved), "--depth", str(tmp_path / "gt.npy")]
    assert main([*call, "--moving", str(tmp_path / "mask.png")]) == 0
    said = capsys.readouterr().out
    moves = next(line for line in said.splitlines() if line.startswith("what moves"))
    assert moves.split()[2] == "0.5000"
    assert "scale and shift" in said
    assert "RMSE   d<1.25" in said
    assert "--path" in refused(*call, "--path", "x.txt")
    np.save(tmp_path / "gt.npy", np.ones((3, 3)))
    assert "differ in size" in refused(*call)
    assert "best" in refused("evaluate", solved, "--depth", "x.npy", "--scale", "best")
    for cap in ("-1", "0", "nan"):
        said = refused("evaluate", solved, "--depth", "x.npy", "--cap", cap)
        assert "cap must be positive" in said


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    pair = render_scene("orbit", 0, 160, 120)
    write_pair(folder, pair)
    cv2.imwrite(str(folder / "flat.png"), np.full((120, 160, 3), 128, np.uint8))
    flow = pair.truth.flow.astype(np.float32)
    write_flo(folder / "true.flo", flow)
    (folder / "cut.flo").write_bytes((folder / "true.flo").read_bytes()[:1000])
    write_flo(folder / "zero.flo", 0 * flow)
    return folder


def solve_files(images: Path, out: Path, **changes: str) -> int:
    options = {"ref": "a.png", "next": "b.png", "intrinsics": "144,144,79.5,59.5"} | changes
    small = options.pop("sets", "segmentation.superpixels=40 segmentation.neighbours=6")
    args = ["solve", *(str(images / options.pop(k)) for k in ("ref", "next"))]
    args += ["--out", str(out), "-q"]
    for key, value in options.items():
        args += [f"--{key}", str(images / value) if key == "flow" else value]
    return main([*args, *sets(small)])


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"ref": "missing.png"}, "missing.png"),
        ({"intrinsics": "0.9,0.9,0.5,0.5"}, "normalised"),
        ({"intrinsics": "a.png,b.png"}, "existing file"),
        ({"intrinsics": "0,0,79.5,59.5"}, "positive fx and fy"),
        ({"intrinsics": "nan,9,1,1"}, "finite"),
        ({"intrinsics": "1,2,3"}, "four numbers"),
        ({"flow": "cut.flo"}, "cut.flo"),
        ({"ref": "flat.png", "next": "flat.png"}, "too few pixels"),
        ({"sets": "segmentation.superpixels=10 segmentation.neighbours=15"}, "K"),
    ],
)
def test_bad_input_is_refused_with_code_2(images, tmp_path, capsys, changes, part):
    assert solve_files(images, tmp_path / "new" / "out", **changes) == 2
    assert not (tmp_path / "new").exists()
    error = capsys.readouterr().err
    assert part in error
    assert "Traceback" not in error


@pytest.mark.parametrize(("flow", "most"), [("zero.flo", 12), ("true.flo", 1)])
def test_little_to_see_is_a_result(flow, most, images, tmp_path):
    """No motion, or one superpixel, which a turn explains: none has a depth of its own."""
    small = f"segmentation.superpixels={most} segmentation.neighbours=4 refine.rounds=1"
    small += " solver.presolve_iterations=2 solver.max_iter=2"
    assert solve_files(images, tmp_path, flow=flow, sets=small) in (0, 1)
    assert all((tmp_path / name).exists() for name in FILES)
    assert main(["check", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["sizes"]["superpixels"] - summary["start"]["interpolated"] == 0
    assert summary["sizes"]["superpixels"] <= most


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("solve a.png", "a pair is two images"),
        ("solve --depth d.npy", "no image and no problem"),
        ("solve a.png b.png c.png", "soup-nlp chain"),
        ("solve street b.png", "street, b.png"),
        ("solve street --depth d.npy", "street and --depth"),
        ("solve street --intrinsics 1,1,0,0", "street and --intrinsics"),
        ("solve street --fov 50", "street and --fov"),
        ("solve", "solve REF NEXT"),
        ("solve clip.mp4", "soup-nlp chain"),
        ("solve .", "soup-nlp chain"),
        ("solve missing.yaml", "problem file is missing"),
        ("solve a.png b.png --intrinsics 50,50", "fx,fy,cx,cy"),
        ("solve a.png b.png --intrinsics 50,50,32,24 --fov 60", "two cameras"),
        ("solve a.png b.png --depth-prior-kind inverse", "a depth prior has a kind, but no source"),
        ("chain missing", "nothing matches it"),
        ("chain scene:stret", "did you mean street"),
        ("chain scene:street --set solver.maxiter=3", "did you mean max_iter"),
        ("check missing", "the folder missing does not exist"),
        (f"check {__file__}", "test_cli.py/result.h5"),
    ],
)
def test_arguments_that_are_no_pair_and_no_result_are_refused(
    words, part, tmp_path, monkeypatch, refused
):
    monkeypatch.chdir(tmp_path)
    assert part in refused(*words.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("solves_once")
def test_frames_of_the_same_names_get_folders_of_their_own(tmp_path, monkeypatch, refused):
    """Results of two pairs frame_0, frame_1 do not replace each other, with and without --out."""
    monkeypatch.chdir(tmp_path)
    for seed, clip in enumerate(("a/clip", "b/clip")):
        (tmp_path / clip).mkdir(parents=True)
        write_pair(tmp_path / clip, render_scene("orbit", seed, 64, 48), ("frame_0", "frame_1"))
    small = ["--superpixels=6", "--neighbours=3", "--no-nlp", "-q", "--fov=50"]
    small += sets("output.page=false refine.rounds=1 refine.particles=4")

    def solve(clip: str) -> list[str]:
        return ["solve", *(f"{clip}/frame_{k}.png" for k in (0, 1)), *small]

    for clip in ("a/clip", "b/clip", "a/clip"):
        assert main(solve(clip)) in (0, 1)
    assert sorted(os.listdir("out")) == ["clip-frame_0-frame_1", "clip-frame_0-frame_1-2"]
    result = Path("out/clip-frame_0-frame_1/result.h5")
    before = result.read_bytes()
    there = [*solve("b/clip"), "--out", str(result.parent)]
    assert "something else" in refused(*there)
    assert result.read_bytes() == before
    assert main([*there, "--overwrite"]) in (0, 1)
    assert result.read_bytes() != before
