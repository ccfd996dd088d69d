"""The check detects every changed file and entry, and rejects damaged ones without a crash."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from soup_nlp.config.problem import dump_problem
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import DataError
from soup_nlp.pipeline.run import solve_pair
from soup_nlp.report.check import CheckReport, check_folder
from soup_nlp.report.claim import HASHED
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.record import RECORD, record_of
from soup_nlp.storage import store
from soup_nlp.storage.mark import MARK

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pair() -> Pair:
    return render_scene("street", 0, 128, 96)


@pytest.fixture(scope="module")
def solved(pair, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("solved") / "out"
    run = solve_pair(
        pair,
        segmentation={"superpixels": 25, "neighbours": 4},
        flow={"source": "truth"},
        solver={"presolve_eps": [0.3, 0.03]},
        refine={"rounds": 1, "particles": 8},
    )
    write_folder(prepare_folder(out), run, dump_problem(run.problem), "a log\n", formats=["npy"])
    return out


@pytest.fixture
def folder(solved, tmp_path) -> Path:
    shutil.copytree(solved, tmp_path / "copy")
    return tmp_path / "copy"


def images(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    return pair.image_ref, pair.image_next


def bad(report: CheckReport) -> list[str]:
    return [row.name for row in report.rows if not row.ok]


def test_every_claim_of_a_result_holds(solved, pair):
    report = check_folder(solved, images(pair))
    assert bad(report) == []
    assert not any("E_photo" in text for text in report.left)
    photos = [row for row in report.rows if row.name.endswith("refined photo")]
    assert len(photos) == 2
    for row in photos:
        # an allowance as large as E_photo would notice nothing
        assert row.limit < 0.05
        assert row.found == pytest.approx(row.claimed, rel=0.01)
    assert any("E_photo" in text for text in check_folder(solved).left)


def test_every_file_is_covered(solved):
    said = {row.name.removesuffix(" as written") for row in check_folder(solved).rows}
    others = {"result.h5", "summary.json", "config.yaml", MARK}
    assert {p.name for p in solved.iterdir()} - others <= said
    assert record_of(solved)["files"].value.size == len(list(solved.iterdir())) - 2


@pytest.mark.parametrize("change", ["flipped", "missing", "longer"])
def test_a_changed_file_is_noticed(change, folder):
    others = {"result.h5", "summary.json", "config.yaml", MARK}
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


def repaired(folder: Path) -> list[str]:
    """Failing claims after the record was renewed: only recomputed claims remain."""
    with h5py.File(folder / "result.h5", "a") as file:
        del file[RECORD]
        store._write_group(file, {RECORD: record_of(folder)})
    return bad(check_folder(folder))


def test_a_forged_depth_map_is_recomputed(folder):
    path = str(folder / "depth_next.png")
    values = cv2.imread(path, cv2.IMREAD_UNCHANGED)
    values[10, 20] += 1
    cv2.imwrite(path, values)
    assert repaired(folder) == ["depth_next.png pixels"]
    cv2.imwrite(path, values[:, :-1])
    assert repaired(folder) == ["depth_next.png pixels"]


@pytest.mark.parametrize("name", ["points_ref.ply", "points_next.ply"])
def test_a_forged_cloud_is_recomputed(name, folder):
    data = bytearray((folder / name).read_bytes())
    head = data.index(b"end_header\n") + 11
    z = np.frombuffer(data, "<f4", 1, head + 8)
    data[head + 8 : head + 12] = (z * np.float32(1.00001)).tobytes()
    (folder / name).write_bytes(data)
    assert f"{name} points" in repaired(folder)


def test_clouds_are_looked_at_one_by_one(folder):
    (folder / "points_ref.ply").write_bytes(b"no cloud")
    assert {"points_ref.ply points", "points_next.ply points"} <= set(repaired(folder))


Change = Callable[[dict], object]
CHANGES: dict[str, tuple[Change, str]] = {
    "scale": (lambda s: s["depth_png_scale"].update(ref=1.0), "depth_png_scale ref"),
    "size": (lambda s: s["sizes"].update(superpixels=7), "size superpixels"),
    "variables": (lambda s: s["sizes"].update(variables=7), "size variables"),
    "iterations": (lambda s: s["iterations"].update({"constrained NLP": 77}), "iterations"),
    "borrowed": (lambda s: s["start"].update(borrowed=99), "start borrowed"),
    "photo": (lambda s: s["refinement"]["end"].update(photo=1.0), "refined photo"),
}


@pytest.mark.parametrize("key", CHANGES)
def test_a_forged_entry_is_recomputed(key, folder, pair):
    change, name = CHANGES[key]
    claims = json.loads((folder / "summary.json").read_text())
    change(claims)
    (folder / "summary.json").write_text(json.dumps(claims))
    if key == "photo":
        assert name in bad(check_folder(folder, images(pair)))
    assert any(row.startswith(name) or key == "photo" for row in repaired(folder))


@pytest.mark.parametrize(
    "place",
    ["versions numpy", "seconds nlp", "start motions", "sizes equalities", "refinement status",
     "flow", "name", "expected", "metrics", "metrics start", "metrics solution mre", "refinement",
     "sizes hessian_nonzeros", "depth_png_scale next", "answer_residuals positive",
     "residuals dual_infeasibility"],
)  # fmt: skip
@pytest.mark.parametrize("how", ["changed", "removed"])
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
    except DataError:
        # a claim that is needed is not there
        assert how == "removed" or place in (
            "metrics",
            "metrics start",
            "refinement status",
            "metrics solution mre",
            "depth_png_scale next",
        )
        return
    assert not report.ok
    assert any(row.how == HASHED and not row.ok for row in report.rows)


def change(folder: Path, edit: Callable[[dict], object]) -> None:
    path = folder / "summary.json"
    claims = json.loads(path.read_text())
    edit(claims)
    path.write_text(json.dumps(claims))


def test_what_a_good_result_claims_is_what_is_found(solved, pair):
    """A row must not show a claimed number that differs from the tested one."""
    bounds = "energy falls", "no round raises E", "no choice below its bound"
    for row in check_folder(solved, images(pair)).rows:
        if row.name in bounds:
            continue
        allowed = max(row.limit, row.limit * abs(row.found)) + 1e-9 * abs(row.found) + 1e-12
        assert abs(row.claimed - row.found) <= allowed, row


def test_rounds_that_raise_the_energy_are_noticed(folder):
    rows = {row.name for row in check_folder(folder).rows}
    assert {"no round raises E", "no choice below its bound"} <= rows
    change(folder, lambda s: s["refinement"]["rounds"][0]["energy"].update(total=1e9))
    assert "no round raises E" in bad(check_folder(folder))


@pytest.mark.parametrize("key", ["status", "delivered", "problem_hash", "seed"])
@pytest.mark.parametrize("smaller", [False, True])
def test_labels_are_those_of_the_arrays(key, smaller, folder):
    """Both neighbours of the right word in the list are wrong."""
    with h5py.File(folder / "result.h5", "a") as file:
        value = file.attrs[key]
        if key == "seed":
            file.attrs[key] = value - 1 if smaller else value + 1
        else:
            file.attrs[key] = value[:1] if smaller else value + b"z"
    name = f"{key.replace('_', ' ')} as in result.h5"
    assert name in bad(check_folder(folder))


def test_a_claim_that_is_missing_is_an_error_of_the_file(folder):
    change(folder, lambda s: s.pop("converged"))
    with pytest.raises(DataError, match="lacks a claim"):
        check_folder(folder)


def test_the_delivered_answer_is_ipopt_s(pair, tmp_path):
    # without the presolve there is no other answer, whatever the rounding
    run = solve_pair(
        pair,
        segmentation={"superpixels": 25, "neighbours": 4},
        flow={"source": "truth"},
        solver={"presolve": False},
        refine={"enabled": False},
    )
    folder = tmp_path / "out"
    write_folder(prepare_folder(folder), run, dump_problem(run.problem), "a log\n")
    assert "nlp is Ipopt's answer" not in bad(check_folder(folder))
    with h5py.File(folder / "result.h5", "a") as file:
        assert file.attrs["delivered"] == b"constrained NLP"
        file["answer/n"][0] = file["answer/n"][1]
    assert "nlp is Ipopt's answer" in bad(check_folder(folder))


@pytest.mark.parametrize(
    "place",
    ["depth/sigma_ref", "iterations/00_presolve_0.3/obj", "truth/flow", "@name", "@machine"],
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
