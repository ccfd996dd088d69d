"""Accuracy over suites: floors and truths by construction, rows that survive, clear refusals."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from soup_nlp import cli_accuracy
from soup_nlp.bench.accuracy import (
    Job,
    clean,
    code_version,
    head,
    input_hash,
    measure,
    settings_hash,
)
from soup_nlp.bench.accuracy_runner import Where, measure_all, read_rows
from soup_nlp.bench.accuracy_table import report
from soup_nlp.bench.planes import fit_planes, plane_depth, points_as_map
from soup_nlp.bench.published import COMPARISON, published
from soup_nlp.bench.rivals import METHODS, RIVALS, unorganised
from soup_nlp.bench.suites import SUITES, Options, list_suite
from soup_nlp.bench.suites_pairs import Item, spread
from soup_nlp.bench.truth import true_soup
from soup_nlp.cli import main
from soup_nlp.config import make_problem
from soup_nlp.data.flow import flow_from_truth
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.data.scenes import render_scene
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model import plain
from soup_nlp.model.energy import Weights, build_energy_data, in_pixels

QUICK = (
    "segmentation.superpixels=40",
    "segmentation.neighbours=6",
    "solver.presolve=false",
    "solver.max_iter=5",
    "refine.rounds=1",
    "refine.particles=6",
)
K = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])


def labelled_planes():
    """(48, 64) labels of two halves and the depth of a plane in each."""
    labels = np.zeros((48, 64), np.int32)
    labels[:, 32:] = 1
    m = np.array([[0.1, -0.05, 0.5], [-0.2, 0.1, 0.25]])
    return labels, m, plane_depth(m, labels, K)


def test_planes_come_back_and_outliers_do_not_pull_them():
    labels, m, depth = labelled_planes()
    np.testing.assert_allclose(fit_planes(labels, depth, K), m, atol=1e-6)
    holes = depth.copy()
    holes[::2] = np.nan
    holes[1, :20] *= 7.0
    np.testing.assert_allclose(fit_planes(labels, holes, K), m, atol=1e-3)
    # no plane is worse than the constant it may always choose
    rough = depth * np.exp(np.random.default_rng(0).normal(0, 0.5, depth.shape))
    fit = plane_depth(fit_planes(labels, rough, K), labels, K)
    for i in (0, 1):
        z = rough[labels == i]
        constant = min(np.mean(np.abs(z - c) / z) for c in z)
        assert np.mean(np.abs(z - fit[labels == i]) / z) <= constant + 1e-12


def test_a_few_rows_of_sky_do_not_cost_the_plane():
    labels, _, depth = labelled_planes()
    sky = depth.copy()
    sky[:5] = 1e3
    fit = plane_depth(fit_planes(labels, sky, K), labels, K)
    for i in (0, 1):
        own = labels == i
        true = np.mean(np.abs(sky - depth)[own] / sky[own])
        assert np.mean(np.abs(sky - fit)[own] / sky[own]) <= true + 1e-3


def test_planes_of_little_truth():
    labels, _, depth = labelled_planes()
    few = np.full(depth.shape, np.nan)
    few[3, 3] = 2.0
    m = fit_planes(labels, few, K)
    assert m[0].tolist() == [0, 0, 0.5]
    assert np.isnan(m[1]).all()
    with pytest.raises(DataError, match="no true depth"):
        fit_planes(labels, np.full(depth.shape, np.nan), K)
    with pytest.raises(DataError, match="differ in size"):
        fit_planes(labels[1:], depth, K)
    sparse = points_as_map(np.array([[1.4, 2.6, 5.0], [99.0, 0.0, 1.0]]), (4, 4))
    assert sparse[3, 1] == 5.0
    assert np.isfinite(sparse).sum() == 1


@pytest.fixture(scope="module")
def street():
    pair = render_scene("street", 0, 256, 112)
    labels = segment(pair.image_ref, 150)
    return pair, build_segmentation(labels, pair.image_ref, 8)


def test_true_soup_is_the_truth_but_for_mixed_superpixels(street):
    pair, seg = street
    true = true_soup(pair, seg)
    rec = reconstruct(true.soup, seg.labels, pair.K_ref, pair.K_next)
    z, gt = rec.depth_ref, pair.truth.depth_ref
    z = z * np.median(gt / z)
    assert np.median(np.abs(z - gt) / gt) < 0.01
    pure = (true.purity == 1.0)[seg.labels]
    gap = np.linalg.norm(rec.flow - pair.truth.flow, axis=2)
    assert np.median(gap[pure]) < 0.1
    assert true.known.all()
    # its motions come out of the scene flow as well as from the bodies
    other = pair.truth.__class__(
        depth_ref=gt, bodies=pair.truth.bodies, scene_flow=pair.truth.scene_flow
    )
    again = true_soup(pair.__class__(**{**vars(pair), "truth": other}), seg)
    np.testing.assert_allclose(again.soup.R, true.soup.R, atol=1e-6)
    with pytest.raises(DataError, match="motions or scene flow"):
        true_soup(pair.__class__(**{**vars(pair), "truth": other.__class__(depth_ref=gt)}), seg)


def test_a_true_plane_seen_from_behind_somewhere_faces_the_camera():
    """Its depth is known on the left only; drawn out to the right the plane passes the camera."""
    height, width = 24, 48
    u = np.arange(width) * np.ones((height, 1))
    labels = (u >= 24).astype(np.int32)
    inverse = np.where(u < 8, 0.5 - 0.05 * u, np.nan)
    depth = np.where(labels == 1, 2.0, 1 / inverse)
    black = np.zeros((height, width, 3), np.uint8)
    truth = Truth(
        depth_ref=depth, bodies=np.zeros((height, width), np.int32), motions=np.eye(4)[None]
    )
    pair = Pair(black, black, K, K, truth=truth)
    true = true_soup(pair, build_segmentation(labels, black, neighbours=1))
    assert true.known.all()
    np.testing.assert_allclose(np.abs(true.soup.n), np.tile([0, 0, 1.0], (2, 1)), atol=1e-9)
    ratio = true.soup.distance / true.soup.distance[1]
    assert ratio[0] == pytest.approx(1 / np.median(inverse[:, :8]) / 2.0, rel=1e-9)
    z = true.soup.depth_at(np.tile([(47 - 32) / 100, 0, 1.0], (2, 1)))
    assert (z > 0).all()


def test_the_truth_has_less_energy_than_a_shaken_truth(street):
    pair, seg = street
    data = build_energy_data(seg, flow_from_truth(pair), pair.K_ref, pair.K_next)
    soup = true_soup(pair, seg).soup
    data = in_pixels(data, soup, seg)
    own = plain.energy(soup, data, Weights())["total"]
    rng = np.random.default_rng(0)
    shaken = soup.__class__(
        soup.lam * np.exp(rng.normal(0, 0.1, len(soup))), soup.n, soup.d, soup.R, soup.t
    )
    assert plain.energy(shaken, data, Weights())["total"] > 1.5 * own


def test_unorganised_superpixels_have_translations_of_length_one(street):
    pair, seg = street
    soup = true_soup(pair, seg).soup
    alone = unorganised(soup)
    length = np.linalg.norm(alone.translation, axis=1)
    np.testing.assert_allclose(length, 1.0, atol=1e-9)
    # the flow of every superpixel stays
    H = soup.homographies(pair.K_ref, pair.K_next)
    np.testing.assert_allclose(alone.homographies(pair.K_ref, pair.K_next), H, atol=1e-9)


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
        # one rigid motion with the true flow is exact on a scene of one body
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


def test_suites_list_the_papers_pairs(tmp_path):
    assert set(SUITES) == {
        *("rendered", "shared", "sintel", "kitti2012", "kitti2015", "vkitti"),
        *("kinect_paper", "kinect_tshirt"),
    }
    rendered = list_suite("rendered", None, Options(width=320, seeds=(0, 3), flows=("dis",)))
    assert len(rendered.items) == 10
    assert len({i.key for i in rendered.items}) == 10
    problem = rendered.items[0].problem(["segmentation.superpixels=60"])
    assert (problem.input.width, problem.input.height) == (320, 136)
    for name, count in (("sintel", 120), ("vkitti", 120), ("kitti2012", 194), ("kitti2015", 200)):
        suite = SUITES[name]
        items = list(suite.build(suite, tmp_path, Options()))
        assert len({i.key for i in items}) == count
        for i in items[:: count // 5]:
            i.problem()  # is a problem that the program accepts
    assert spread(10, 3) == [1, 5, 8]
    assert spread(4, 9) == [0, 1, 2, 3]


def test_a_suite_takes_what_is_there(tmp_path):
    base = tmp_path / "data" / "sintel" / "training" / "clean" / "alley_1"
    base.mkdir(parents=True)
    suite = SUITES["sintel"]
    frames = [i.input["frame"] for i in suite.build(suite, tmp_path, Options())][:2]
    for frame in frames:
        (base / f"frame_{frame:04d}.png").touch()
    (base / f"frame_{frames[0] + 1:04d}.png").touch()
    listing = list_suite("sintel", tmp_path / "data")
    assert [i.input["frame"] for i in listing.items] == frames[:1]
    assert "119 of the list are not in the folder" in str(listing)


def test_a_limit_counts_pairs_and_keeps_every_flow(tmp_path):
    listing = list_suite("rendered", None, Options(limit=2))
    assert len({i.name for i in listing.items}) == 2
    assert len(listing.items) == 4
    assert str(listing) == "suite rendered: 2 pairs (4 rows), 3 left out by the limit"
    base = tmp_path / "image_0"
    base.mkdir()
    for index in range(4):
        for frame in (10, 11):
            (base / f"{index:06d}_{frame}.png").touch()
    listing = list_suite("kitti2012", tmp_path, Options(limit=3, flows=("truth", "dis")))
    text = "3 pairs (6 rows), 1 left out by the limit, 190 of the list are not in the folder"
    assert str(listing) == f"suite kitti2012: {text}"


def test_sintel_needs_its_cameras_but_for_the_scene_whose_camera_is_known(tmp_path):
    suite = SUITES["sintel"]
    for i in suite.build(suite, tmp_path, Options()):
        if i.sequence in ("alley_1", "temple_2"):
            for path in i.needs:
                if path.suffix == ".png":
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.touch()
    assert {i.sequence for i in list_suite("sintel", tmp_path).items} == {"alley_1"}
    camera = tmp_path / "camdata_left" / "temple_2"
    camera.mkdir(parents=True)
    for frame in range(1, 51):
        (camera / f"frame_{frame:04d}.cam").touch()
    assert len(list_suite("sintel", tmp_path).items) == 48


@pytest.mark.parametrize("name", [n for n, s in SUITES.items() if s.layout])
def test_a_missing_dataset_says_where_to_get_it(name, tmp_path, capsys):
    assert main(["bench", "accuracy", "--suite", name, "--data", str(tmp_path)]) == 2
    text = capsys.readouterr().err
    assert "get it from" in text
    assert "expected:" in text


def solved(suite: str, convention: str = "paper") -> dict:
    """A row of one convention, without a solve."""
    return {
        **{"key": "k", "ok": True, "good": True, "suite": suite, "pair": "p"},
        **{"sequence": "s", "flow": "dis", "presets": [convention], "status": "x", "code": "c"},
        **{"metrics": {convention: {"solution": {"mre": 0.03}, "constant": {"mre": 0.04}}}},
        **{"flow_error": None, "scene_flow": None, "cpu_seconds": 1.0},
        "energy": {"solution": {"total": 1.0}},
    }


def test_every_pair_is_in_the_detail_of_its_own_convention():
    text = report("T", [solved("shared"), {**solved("shared", "kitti"), "pair": "q"}])
    detail = text.split("## The solution, ")[1:]
    assert [part.partition(":")[0] for part in detail] == ["paper", "kitti"]
    assert "| p | dis |" in detail[0]
    assert "| q | dis |" in detail[1]


def test_a_table_says_what_its_planes_are_fitted_to():
    for convention, said in (("paper", False), ("near20", True), ("eigen80", True)):
        row = solved("shared", convention)
        row["metrics"][convention]["plane"] = {"mre": 0.05}
        assert ("`plane`: fitted to all true pixels" in report("T", [row])) is said


def test_a_table_says_where_its_convention_is_not_the_usual_one():
    assert "the scale is the median of z_gt / z" in report("T", [solved("kitti2015", "eigen80")])


def test_published_numbers_are_marked():
    assert published("kitti2015") == dict(COMPARISON["kitti"])
    assert published("rendered") == {}
    row = solved("kinect_paper")
    text = report("T", [row])
    assert "| BMM (published) | 0.0322 |" in text
    assert "(measured) | 0.0300 |" in text
    assert "beats every rival on 1 of 1" in text
    # of the pairs that have a number, under the name of the convention, on what data
    bare = {**solved("kitti2015", "kitti"), "metrics": {}}
    failed = {**bare, "ok": False, "error": "out of luck"}
    text = report("T", [solved("kitti2015", "kitti"), bare, failed])
    assert "| this program, flow dis, kitti, 1 pair (measured) | 0.0300 |" in text
    assert "odometry set 00-09 with LiDAR truth" in text
    assert "\n\n## Failed\n" in text
    # one rigid motion is met on its own pixels
    metrics = row["metrics"]["paper"]
    metrics |= {"rigid": {"mre": 0.025, "coverage": 0.6}, "solution_rigid": {"mre": 0.02}}
    assert "beats every rival on 1 of 1" in report("T", [row])
    metrics["solution_rigid"]["mre"] = 0.026
    text = report("T", [row])
    assert "beats every rival on 0 of 1" in text
    assert "| p | dis | paper | rigid | 0.0250 | 0.0260 | 60.0% | -0.0010 |" in text
    assert set(RIVALS) <= set(METHODS)


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
