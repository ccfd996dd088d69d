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
from soup_nlp.geometry.camera import intrinsics, pixel_grid, project, rays
from soup_nlp.pipeline.run import solve_pair
from soup_nlp.report.check import WRITTEN, CheckReport, check_folder
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.result import RENAMED, load
from soup_nlp.sequence.folder import convert
from soup_nlp.storage.folders import SUMS, Sums, digest_of, files_in, write_sums

pytestmark = pytest.mark.slow


SMALL = {"segmentation": {"superpixels": 25, "neighbours": 4}, "flow": {"source": "truth"}}
EXACT = {"segmentation": {"superpixels": 20, "neighbours": 8}, "refine": {"enabled": False}}


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("solved") / "out"
    # without the presolve there is no other answer than Ipopt's, which need not converge
    short = {"presolve_iterations": 0, "max_iter": 10}
    options = {"solver": short, "refine": {"rounds": 1, "particles": 8}}
    run = solve_pair(render_scene("street", 0, 128, 96), **SMALL, **options)
    write_folder(prepare_folder(out), run, "a log\n", formats=["npy"])
    return out


@pytest.fixture
def folder(solved, tmp_path) -> Path:
    shutil.copytree(solved, tmp_path / "copy")
    return tmp_path / "copy"


def relist(folder: Path) -> None:
    """Make the list valid for the files as they are now."""
    write_sums(folder, Sums({name: digest_of(folder / name) for name in files_in(folder)}))


def bad(report: CheckReport) -> list[str]:
    return [row.name for row in report.rows if not row.ok]


def test_every_claim_of_a_result_holds_and_every_file_is_covered(solved):
    report = check_folder(solved)
    assert bad(report) == []
    assert str(report).count("ok  ") == len(report.rows)
    said = [row.name.removesuffix(" as written") for row in report.rows if row.how == WRITTEN]
    assert said == sorted({p.name for p in solved.iterdir()} - {SUMS})


@pytest.mark.parametrize("change", ["flipped", "missing", "longer"])
def test_a_changed_file_is_noticed(change, folder):
    names = {p.name for p in folder.iterdir()} - {SUMS}
    # a change by HDF5 itself has valid checksums
    with h5py.File(folder / "result.h5", "a") as file:
        file["depth/sigma_ref"][0, 0] += 1e-3
    # without these two there is nothing to check; a space is no change of the entries
    for name in names - (set() if change == "longer" else {"result.h5", "summary.json"}):
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= change == "flipped"
        (folder / name).write_bytes(data + b" " * (change == "longer"))
        if change == "missing":
            (folder / name).unlink()
    same = set() if change == "longer" else {"summary.json"}
    assert {f"{name} as written" for name in names - same} <= set(bad(check_folder(folder)))


FORGED = {
    "depth/ref": "depth map solution",
    "start/n": "energy start proj",
    "nlp/lam": "nlp simplex",
    "answer/R": "answer so3",
    "truth/depth_ref": "other scores solution",
}


@pytest.mark.parametrize("place", FORGED)
def test_forged_arrays_are_recomputed(place, folder):
    """With a valid list."""
    with h5py.File(folder / "result.h5", "a") as file:
        file[place][...] = 1.01 * file[place][...]
    relist(folder)
    report = check_folder(folder)
    assert FORGED[place] in bad(report)
    assert f"FAIL {FORGED[place]}" in str(report)
    if place == "answer/R":
        (so3,) = (row for row in report.rows if row.name == "answer so3")
        # R'R = 1.02 I
        assert re.match(r"25 of 25 beyond .*; worst superpixels \d+ \(2\.0e-02\)", so3.note)


def test_a_result_with_the_names_of_before_is_read(folder):
    start = load(folder).tree["start"]
    with h5py.File(folder / "result.h5", "a") as file:
        for name, older in RENAMED.items():
            file.move(f"start/{name}", f"start/{older}")
    assert np.array_equal(load(folder).tree["start"]["origin"], start["origin"])
    relist(folder)
    assert bad(check_folder(folder)) == []


@pytest.mark.parametrize(("off", "good"), [(1e-10, True), (1e-7, False)])
def test_numbers_agree_but_for_rounding(off, good, folder):
    claims = json.loads((folder / "summary.json").read_text())
    claims["energy"]["solution"]["total"] *= 1 + off
    claims["metrics"]["solution"]["mre"] *= 1 + off
    (folder / "summary.json").write_text(json.dumps(claims))
    relist(folder)
    found = {"energy solution total", "mre solution"} & set(bad(check_folder(folder)))
    assert len(found) == (0 if good else 2)


@pytest.mark.parametrize("kept", [[], ["depth_ref.png"]])
def test_a_folder_without_a_valid_list_is_noticed(kept, folder):
    write_sums(folder, Sums({name: digest_of(folder / name) for name in kept}))
    assert bad(check_folder(folder)) == ["files as written"]


def test_a_changed_file_is_noticed_after_a_conversion(folder):
    (folder / "depth_ref.png").write_bytes(b"other")
    assert convert(folder, ["pfm"]) == ["depth_ref.pfm", "depth_next.pfm"]
    assert bad(check_folder(folder)) == ["depth_ref.png as written"]
    (folder / "depth_next.pfm").unlink()
    assert bad(check_folder(folder)) == ["depth_next.pfm as written", "depth_ref.png as written"]


def test_a_term_that_a_result_does_not_have_is_absent(folder):
    """As in a result that was stored before E_order and E_prior were added."""
    claims = json.loads((folder / "summary.json").read_text())
    with h5py.File(folder / "result.h5", "a") as file:
        for name, weight in (("prior", "prior_weight"), ("order", "order_weight")):
            del file[f"energy/{weight}"], file[f"weights/{name}"]
            for energy in claims["energy"].values():
                energy["total"] -= energy.pop(name, 0.0)
    (folder / "summary.json").write_text(json.dumps(claims))
    found = {name for name in bad(check_folder(folder)) if "as written" not in name}
    assert not {name for name in found if name.startswith("energy")}


def test_the_delivered_answer_is_ipopt_s(folder):
    with h5py.File(folder / "result.h5", "a") as file:
        assert file.attrs["name"] == b"pair"
        file["answer/n"][0] = file["answer/n"][1]
    assert "nlp is Ipopt's answer" in bad(check_folder(folder))


def one_plane() -> Pair:
    """A plane and a motion with an exact flow, so that E is zero up to rounding."""
    K, uv = intrinsics(100, 100, 79.5, 39.5), pixel_grid(80, 160)
    ray = rays(K, uv)
    points = (2.0 / (ray @ [-0.1, -0.2, 0.97]))[..., None] * ray
    turn = cv2.Rodrigues(np.array([0.01, 0.02, -0.005]))[0]
    flow = project(K, points @ turn.T + [0.2, 0.02, 0.1]) - uv
    grey = np.full((80, 160, 3), 128, np.uint8)
    return Pair(grey, grey, K, K, Flow(flow, np.ones((80, 160), np.float32), "exact"))


@pytest.mark.parametrize("place", ["metrics", "residuals", "energy nlp proj"])
def test_claims_that_are_missing_are_named(place, folder):
    *above, last = place.split()
    claims = json.loads((folder / "summary.json").read_text())
    here = claims
    for key in above:
        here = here[key]
    del here[last]
    (folder / "summary.json").write_text(json.dumps(claims))
    with pytest.raises(DataError, match=f"(?s)lacks .*{last}"):
        check_folder(folder)


def test_an_energy_of_rounding_size_passes_the_check(tmp_path):
    # a slanted plane has relief, which E_prior charges
    run = solve_pair(one_plane(), energy={"weights": {"prior": 0.0}}, **EXACT)
    write_folder(prepare_folder(tmp_path), run, "")
    assert run.energy["total"] < 1e-9
    assert bad(check_folder(tmp_path)) == []
    path = tmp_path / "summary.json"
    claims = json.loads(path.read_text())
    # 1e-7 is far below a pixel, but no rounding of coordinates up to 160
    for off, expected in ((1e-11, []), (1e-7, ["energy solution proj"])):
        claims["energy"]["solution"]["proj"] += off
        path.write_text(json.dumps(claims))
        wrong = bad(check_folder(tmp_path))
        assert [name for name in wrong if name != "summary.json as written"] == expected
