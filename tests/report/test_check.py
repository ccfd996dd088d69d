"""The check detects every changed file and entry, and rejects damaged ones without a crash."""

import json
import re
import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid, project, rays
from soup_nlp.pipeline.run import solve_pair
from soup_nlp.report.check import WRITTEN, CheckReport, check_folder
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.layout import record_of, rows_in_file
from soup_nlp.storage import store
from soup_nlp.storage.folders import MARK, digest_of, files_in
from soup_nlp.storage.h5_files import DIGEST, RECORD, read_digest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pair() -> Pair:
    return render_scene("street", 0, 128, 96)


SMALL = {"segmentation": {"superpixels": 25, "neighbours": 4}, "flow": {"source": "truth"}}


@pytest.fixture(scope="module")
def solved(pair, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("solved") / "out"
    options = {"solver": {"presolve_eps": [0.3, 0.03]}, "refine": {"rounds": 1, "particles": 8}}
    run = solve_pair(pair, **SMALL, **options)
    write_folder(prepare_folder(out), run, "a log\n", formats=["npy"])
    return out


@pytest.fixture
def folder(solved, tmp_path) -> Path:
    shutil.copytree(solved, tmp_path / "copy")
    return tmp_path / "copy"


def record(folder: Path) -> store.Tree:
    """A valid record of the files as they are now."""
    digests = {name: digest_of(folder / name) for name in files_in(folder) if name != "result.h5"}
    return record_of(digests, (folder / "summary.json").read_text())


def bad(report: CheckReport) -> list[str]:
    return [row.name for row in report.rows if not row.ok]


def test_every_claim_of_a_result_holds(solved):
    report = check_folder(solved)
    assert bad(report) == []
    assert str(report).count("ok  ") == len(report.rows)


def test_every_file_is_covered(solved):
    said = {row.name.removesuffix(" as written") for row in check_folder(solved).rows}
    others = {"result.h5", "summary.json", MARK}
    assert {p.name for p in solved.iterdir()} - others <= said
    assert len(record(solved)["files"]) == len(list(solved.iterdir())) - 2


@pytest.mark.parametrize("change", ["flipped", "missing", "longer"])
def test_a_changed_file_is_noticed(change, folder):
    others = {"result.h5", "summary.json", MARK}
    names = {p.name for p in folder.iterdir()} - others
    for name in names:
        data = bytearray((folder / name).read_bytes())
        if change == "missing":
            (folder / name).unlink()
            continue
        if change == "longer":
            data += b"x"
        else:
            data[len(data) // 2] ^= 1
        (folder / name).write_bytes(data)
    assert {f"{name} as written" for name in names} <= set(bad(check_folder(folder)))


FORGED = {
    "depth/ref": "depth map solution",
    "start/n": "energy start proj",
    "nlp/lam": "nlp simplex",
    "answer/R": "answer so3",
    "truth/depth_ref": "other scores solution",
}


@pytest.mark.parametrize("place", FORGED)
def test_forged_arrays_are_recomputed(place, folder):
    """With a valid record and digest."""
    with h5py.File(folder / "result.h5", "a") as file:
        file[place][...] = 1.01 * file[place][...]
        file.attrs[DIGEST] = ""
        del file[RECORD]
        store._write_group(file, {RECORD: record(folder)}, rows_in_file())
    with h5py.File(folder / "result.h5", "a") as file:
        file.attrs[DIGEST] = read_digest(folder / "result.h5")
    report = check_folder(folder)
    assert FORGED[place] in bad(report)
    assert f"FAIL {FORGED[place]}" in str(report)
    if place == "answer/R":
        (so3,) = (row for row in report.rows if row.name == "answer so3")
        # R'R = 1.02 I
        assert re.match(r"25 of 25 beyond .*; worst superpixels \d+ \(2\.0e-02\)", so3.note)


ENTRIES = (
    "versions numpy", "seconds nlp", "flow", "metrics start", "expected", "metrics", "refinement",
    "metrics solution mre", "refinement status", "residuals dual_infeasibility",
    "depth_png_scale next", "delivered",
)  # fmt: skip


@pytest.mark.parametrize(
    ("how", "place"),
    [*(("changed", place) for place in ENTRIES), *(("removed", place) for place in ENTRIES[::3])],
)
def test_entries_are_as_written(how, place, folder):
    *above, last = place.split()
    claims = json.loads((folder / "summary.json").read_text())
    here = claims
    for key in above:
        here = here[key]
    if how == "removed":
        del here[last]
    elif isinstance(here[last], dict):
        here[last]["more"] = 1
    else:
        here[last] = 1 if isinstance(here[last], str) else "other"
    (folder / "summary.json").write_text(json.dumps(claims))
    try:
        report = check_folder(folder)
    except DataError as error:
        # a claim that is needed is not there
        needed = ("metrics", "metrics start", "refinement status", "metrics solution mre")
        missing = how == "removed" and "lacks a claim" in str(error)
        if not missing and place not in (*needed, "depth_png_scale next"):
            raise
        return
    assert not report.ok
    assert any(row.how == WRITTEN and not row.ok for row in report.rows)


def test_the_delivered_answer_is_ipopt_s(pair, tmp_path):
    # without the presolve there is no other answer, whatever the rounding
    run = solve_pair(pair, **SMALL, solver={"presolve": False}, refine={"enabled": False})
    folder = tmp_path / "out"
    write_folder(prepare_folder(folder), run, "a log\n")
    assert "nlp is Ipopt's answer" not in bad(check_folder(folder))
    with h5py.File(folder / "result.h5", "a") as file:
        assert file.attrs["delivered"] == b"constrained NLP"
        file["answer/n"][0] = file["answer/n"][1]
    assert "nlp is Ipopt's answer" in bad(check_folder(folder))


@pytest.mark.parametrize(
    "place",
    ["depth/sigma_ref", "iterations/00_majorant_0.3/obj", "truth/flow", "@name", "@machine"],
)
def test_contents_of_the_arrays_are_as_written(place, folder):
    """Changes made with HDF5 itself have valid checksums."""
    with h5py.File(folder / "result.h5", "a") as file:
        if place.startswith("@"):
            file.attrs[place[1:]] = "other"
        else:
            first = (0,) * file[place].ndim
            file[place][first] += 1e-3
    assert "contents of result.h5 as written" in bad(check_folder(folder))


# --- rounding of an energy that should be zero ---

# the flow is exact, and the images show nothing that contradicts it
EXACT = {"segmentation": {"superpixels": 50, "neighbours": 8}, "refine": {"photo": 0.0}}


def one_plane() -> Pair:
    """A plane and a motion with an exact flow, so that E is zero up to rounding."""
    shot = render_scene("orbit", 0, 320, 160)
    uv = pixel_grid(*shot.size)
    ray = rays(shot.K_ref, uv)
    points = (2.0 / (ray @ [-0.1, -0.2, 0.97]))[..., None] * ray
    turn = cv2.Rodrigues(np.array([0.01, 0.02, -0.005]))[0]
    flow = project(shot.K_next, points @ turn.T + [0.2, 0.02, 0.1]) - uv
    sure = np.ones(shot.size, np.float32)
    grey = np.full_like(shot.image_ref, 128)
    return Pair(grey, grey, shot.K_ref, shot.K_next, Flow(flow, sure, "exact"))


def test_an_energy_of_rounding_size_passes_the_check(tmp_path):
    # a slanted plane has relief, which E_prior charges
    run = solve_pair(one_plane(), energy={"weights": {"prior": 0.0}}, **EXACT)
    write_folder(prepare_folder(tmp_path), run, "")
    assert run.energy["total"] < 1e-9
    assert bad(check_folder(tmp_path)) == []
    path = tmp_path / "summary.json"
    claims = json.loads(path.read_text())
    # 1e-7 is far below a pixel, but no rounding of coordinates up to 320
    for off, expected in ((3e-11, []), (1e-7, ["energy solution proj"])):
        claims["energy"]["solution"]["proj"] += off
        path.write_text(json.dumps(claims))
        wrong = bad(check_folder(tmp_path))
        # whatever is changed in the file differs from its copy in result.h5
        assert [name for name in wrong if name != "entries of summary.json"] == expected
