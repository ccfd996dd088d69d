"""The folder, page and commands of a sequence."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers_files import sets
from helpers_result import CAMERA, CERTAINTY, toy_pairs

import soup_nlp
from soup_nlp.batches import run as batches
from soup_nlp.cli.main import main
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ConfigError, DataError, SolverError, SoupError
from soup_nlp.pipeline.case import observed_pair
from soup_nlp.report.figures import write_png
from soup_nlp.report.folder import head
from soup_nlp.report.models import POINTS, fuse
from soup_nlp.report.pictures import pictures
from soup_nlp.sequence import solve as solving
from soup_nlp.sequence.folder import chain_files, write_chain
from soup_nlp.sequence.frames import Frames
from soup_nlp.sequence.links import make_chain
from soup_nlp.sequence.score import chain_exit_code, chain_lines
from soup_nlp.sequence.solve import one_camera

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]


def test_a_chain_is_written(tmp_path):
    chain = make_chain(toy_pairs())
    chain = write_chain(tmp_path, chain, "toy & co", ["a.png", "b.png", "</script>"])
    files = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert files == set(chain_files(3))
    told = json.loads((tmp_path / "chain.json").read_text())
    assert told["sources"] == ["a.png", "b.png", "</script>"]
    assert told["score"] is None
    assert chain_lines(chain)[1].split()[:4] == ["pairs", "ratio", "of", "scales"]
    assert chain_lines(chain)[2].split()[:3] == ["0,", "1", "2.000"]
    assert "ratio of scales" in (tmp_path / "report.html").read_text()
    # two frames have no link, so no head of a table
    assert chain_lines(make_chain(toy_pairs()[:1]))[1].startswith("tracks")
    np.testing.assert_allclose([s["scale"] for s in told["scales"]], [1, 2], rtol=1e-9)
    for k in range(3):
        path = str(tmp_path / "depth" / f"{k:04d}.png")
        found = cv2.imread(path, cv2.IMREAD_UNCHANGED) / told["depth_png_scale"]
        known = np.isfinite(chain.depth(k))
        np.testing.assert_allclose(
            found[known], chain.depth(k)[known], atol=0.51 / told["depth_png_scale"]
        )
    # the board is one track
    assert [t["track"] for t in told["tracks"]] == [1]
    assert [*told["tracks"][0]["path"]] == ["0", "1", "2"]
    poses = np.loadtxt(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(poses[1, 1:4], CAMERA.centre, atol=1e-8)


def test_a_chain_says_which_depth_is_drawn(tmp_path):
    shares = CERTAINTY | {"measured": 0.0, "drawn": 1.0, "median_sigma": None}
    sure = toy_pairs()

    def unsure(pair):
        rec = replace(pair.reconstruction, sigma_ref=np.full((60, 80), 1.2))
        summary = {**pair.summary, "certainty": shares}
        return replace(pair, reconstruction=rec, summary=summary, kind=np.full_like(pair.kind, 2))

    half, none = make_chain([sure[0], unsure(sure[1])]), make_chain([*map(unsure, sure)])
    for chain, share, code in ((make_chain(sure), 0, 0), (half, 50, 0), (none, 100, 1)):
        chain = write_chain(tmp_path, chain, "toy", ["a.png", "b.png", "c.png"])
        told = json.loads((tmp_path / "chain.json").read_text())
        assert told["certainty"]["drawn"] == pytest.approx(share / 100)
        said = f"{share}% of all images is drawn: nothing tells its depth"
        text = (tmp_path / "report.html").read_text()
        assert (f"<strong>{said}" in text) == bool(share)
        assert "<strong></strong>" not in text
        assert f", {share}% drawn)" in str(chain)
        lines = "\n".join(chain_lines(chain))
        assert (said in lines) == bool(share)
        assert ("half of it to 7.0%" in lines) == (share < 100)
        assert chain_exit_code(chain)[0] == code
    assert chain_exit_code(none)[1].startswith(said)
    # of the last frame, the next one of an unsure pair, what no other frame shows is unknown
    assert [half[k].drawn.mean() for k in range(2)] == [0, 1]
    np.testing.assert_array_equal(half[2].drawn, np.isfinite(half.depth(2)))
    first, second = (pictures(half, k)["depth_ref"].image for k in range(2))
    # what is unknown is grey
    assert second[np.isfinite(half.depth(1))].min() >= 165 > first.min()
    assert fuse(none).size == 0


START_ALONE = sets("refine.enabled=false solver.presolve_iterations=0 solver.max_iter=1")


@pytest.mark.filterwarnings("default:.*the key white")
@pytest.mark.parametrize(("order", "workers"), [([0, 0, 1, 1, 2], 1), ([0, 0], 2)])
def test_duplicate_frames_are_bridged(order, workers, tmp_path, capfd):
    """A recording that starts and pauses at rest, or rests all the time; one that warns."""
    for k, frame in enumerate(order):
        deep = np.uint16(render_scene("orbit", 0, 96, 64, frame).image_ref) * 16
        cv2.imwrite(str(tmp_path / f"{k}.png"), deep)
    np.savetxt(tmp_path / "K.txt", render_scene("orbit", 0, 96, 64).K_ref)
    call = ["chain", str(tmp_path), "-o", str(tmp_path / "out"), "-q", "--workers", str(workers)]
    code = main([*call, "--superpixels", "16", "--neighbours", "5", *START_ALONE])
    told = json.loads((tmp_path / "out" / "chain.json").read_text())
    # pairs of one frame are drawn: all, or two of four
    assert told["certainty"]["drawn"] == pytest.approx(1.0 if len(order) == 2 else 0.5, abs=0.1)
    assert code == (told["certainty"]["drawn"] > 0.5)
    links = {tuple(link["pairs"]): link for link in told["links"]}
    for k in range(len(order) - 2):
        same = len({*order[k : k + 3]}) < 3
        assert links[k, k + 1]["flagged"] == same
    if len(order) > 2:
        assert links[1, 3]["bridge"]
        assert not links[1, 3]["flagged"]
    # one line for the warning of each pair, also of worker processes
    lines = capfd.readouterr().err.splitlines()
    told = [line[:8] for line in lines if "the key white" in line]
    assert told == ["warning:"] * (len(order) - 1)
    assert not any("DataWarning" in line for line in lines)


SMALL = sets(
    "input.width=160 input.height=108 segmentation.superpixels=25 flow.source=truth"
    " refine.enabled=false segmentation.neighbours=8"
)


def test_a_rendered_sequence_has_one_scale(tmp_path, capsys, refused, monkeypatch):
    out = tmp_path / "out"
    call = ["chain", "scene:street", "--frames", "3", "--out", str(out), "-q", *SMALL]
    assert main(call) == 0
    printed = capsys.readouterr().out
    told = json.loads((out / "chain.json").read_text())
    (one,) = told["links"]
    # the static scene has exact flow; planes of 400 pixels cost a few per cent
    own = [frame["own_scale"] for frame in told["score"]["frames"]]
    np.testing.assert_allclose(own, own[0], rtol=0.02)
    assert told["score"]["cost"] < 0.02
    assert told["score"]["path"]["share"] < 0.01
    assert "with one for the sequence" in printed
    line = next(line for line in printed.splitlines() if line.startswith("0, 1"))
    assert float(line.split()[2]) == round(one["ratio"], 3)
    # the folder is a result
    assert main(["check", str(out)]) == 0
    assert "camera poses by pairs and scales" in capsys.readouterr().out
    for name in ("depth/0000.png", "trajectory.tum"):
        data = (out / name).read_bytes()
        (out / name).write_bytes(data[:-20] + bytes([data[-20] ^ 1]) + data[-19:])
        assert main(["check", str(out)]) == 1
        assert f"{name} as written" in capsys.readouterr().out.split("FAIL")[-1]
        (out / name).write_bytes(data)
    assert main(["convert", str(out), "--to", "ply,colmap", "-o", str(tmp_path / "more")]) == 0
    assert main(["view", str(out), "--renew", "--no-open"]) == 0
    page = (out / "report.html").read_bytes()
    (out / "report.html").write_bytes(page + b"mine")
    assert "would be overwritten" in refused("view", out, "--renew", "--no-open")
    assert (out / "report.html").read_bytes() == page + b"mine"
    (out / "report.html").write_bytes(page)
    capsys.readouterr()
    loaded = soup_nlp.load(out)
    np.testing.assert_allclose(loaded.scales, [row["scale"] for row in told["scales"]])
    assert loaded.name == told["name"]
    rows = (tmp_path / "more" / "colmap" / "sparse" / "0" / "points3D.txt").read_text()
    assert len(rows.splitlines()) == 2 + min(POINTS, len(rows.splitlines()) - 2) > 1000
    poses = (tmp_path / "more" / "colmap" / "sparse" / "0" / "images.txt").read_text()
    # two lines for each frame, also the last one, which sees points too
    assert len(poses.splitlines()) == 2 + 2 * 3
    assert len(poses.splitlines()[-1].split()) > 300
    for k in range(3):
        truth = render_scene("street", 0, 160, 108, k).truth.depth_ref
        (tmp_path / "true").mkdir(exist_ok=True)
        np.save(tmp_path / "true" / f"{k}.npy", truth)
    assert main(["evaluate", str(out), "--depth", str(tmp_path / "true")]) == 0
    assert f"{told['score']['mre_one_scale']:.4f}" in capsys.readouterr().out
    for rule in (["--scale", "lsq"], ["--cap", "70"]):
        said = refused("evaluate", out, "--depth", tmp_path / "true", *rule)
        assert f"found: {' '.join(rule)}" in said
    assert len(np.loadtxt(out / "trajectory.tum")) == 3
    # what is solved is not solved again
    rows = (out / "pairs.jsonl").read_text()
    capsys.readouterr()
    assert main([word for word in call if word != "-q"]) == 0
    assert "the chain is finished" in capsys.readouterr().err
    assert (out / "pairs.jsonl").read_text() == rows
    # a file of the user is overwritten on request only
    (out / "chain.json").write_text("mine")
    assert "would be overwritten" in refused(*call)
    assert main([*call, "--overwrite"]) == 0
    # nor are its pairs replaced under it
    other = [*call, *START_ALONE]
    assert "solved otherwise" in refused(*other)
    with monkeypatch.context() as m:
        m.setattr(solving, "each", ended)
        assert main([*other, "--overwrite"]) == 130
    assert "chain is not finished" in refused("check", out)
    assert main(other) in (0, 1)


def ended(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.parametrize("kind", ["rows", "pairs.jsonl", "pairs", "pairs/001_002"])
@pytest.mark.parametrize("command", ["chain", "batch"])
def test_no_command_writes_into_what_is_the_users(command, kind, tmp_path, monkeypatch, refused):
    monkeypatch.setattr(solving, "each", None)
    monkeypatch.setattr(batches, "each", None)
    out, mine = tmp_path / "out", tmp_path / "mine"
    link = out / ("pairs.jsonl" if kind == "rows" else kind)
    link.parent.mkdir(parents=True)
    if kind in ("rows", "pairs.jsonl"):
        (link if kind == "rows" else mine).write_text("mine")
    else:
        mine.mkdir()
    if kind != "rows":
        link.symlink_to(mine)
    problem = tmp_path / "pair.yaml"
    problem.write_text("name: 001_002\ninput: {kind: scene, scene: street}\n")
    words = {"chain": ["scene:street", "--frames", "3"], "batch": [str(problem)]}
    before = sorted(tmp_path.rglob("*"))
    for more in ([], ["--overwrite"]):
        assert str(out) in refused(command, *words[command], "-o", out, "-q", *more)
    assert sorted(tmp_path.rglob("*")) == before


def test_frames_are_not_written_through_a_link(tmp_path):
    out, mine = tmp_path / "out", tmp_path / "mine"
    out.mkdir()
    mine.mkdir()
    (out / "frames").symlink_to(mine)
    with pytest.raises(DataError, match="link"):
        soup_nlp.chain([np.zeros((48, 64, 3), np.uint8)] * 2, out, fov=60)
    assert not any(mine.iterdir())


def test_a_pair_that_was_solved_otherwise_is_solved_again(tmp_path, monkeypatch, refused):
    seen = []

    def solve(problem, folder):
        place = folder / "pairs" / problem.name
        if place.name == "001_002":
            raise DataError("no flow")
        seen.append(problem.seed)
        place.mkdir(parents=True, exist_ok=True)
        (place / "result.h5").touch()
        return {}

    def pairs(count, seed):
        frames = Frames(("a",) * (count + 1), scene="street", keys={"seed": seed})
        problems = {one.name: one for one in map(frames.problem, range(count))}
        return problems, {name: head(problem) for name, problem in problems.items()}

    monkeypatch.setattr(solving.stored, "solve_into", solve)
    for seed in (1, 1, 2, 1):
        solving.solve_pairs(*pairs(1, seed), tmp_path)
        assert (tmp_path / "pairs" / "000_001" / "result.h5").is_file()
    assert seen == [1, 2, 1]
    with pytest.raises(SolverError, match="1 of 2 pairs"):
        solving.solve_pairs(*pairs(2, 1), tmp_path)
    for command in ("view", "check"):
        error = refused(command, tmp_path)
        assert "found: pairs in pairs/: 2, failed: 001_002" in error
        assert "the same soup-nlp chain command goes on" in error


@pytest.mark.filterwarnings("ignore:.*no intrinsics")
def test_frames_without_a_camera_get_one_focal_length(tmp_path):
    names = [str(tmp_path / f"{k}.png") for k in range(3)]
    for k, name in enumerate(names):
        pair = render_scene("room", 1, 200, 135, k)
        write_png(name, pair.image_ref)
    frames = Frames(tuple(names), keys={"segmentation": {"superpixels": 30}})
    camera = one_camera(frames).camera
    focal = 100 / np.tan(np.radians(camera["fov"] / 2))
    assert focal == pytest.approx(pair.K_ref[0, 0], rel=0.1)  # the guess is 1.5 times as long
    assert 0.05 <= camera["focal_sigma"] < 0.2
    # the solve of a pair takes it as it is
    found = observed_pair(replace(frames, camera=camera).problem(0))
    assert found.K_ref[0, 0] == pytest.approx(focal)
    assert found.focal_sigma == camera["focal_sigma"]
    known = Frames(tuple(names), {"fov": 60})
    assert one_camera(known) is known
    # pairs without a flow say nothing
    for name in names:
        write_png(name, np.full((72, 96, 3), 128, np.uint8))
    flat = Frames(tuple(names), overrides=("segmentation.superpixels=20",))
    assert one_camera(flat) is flat


def test_a_chain_takes_the_keys_of_a_pair_and_files_of_every_pair(tmp_path):
    """In Python as on the command line: flows and depths of a folder, sections, frames."""
    for kind in ("clip", "flow", "depth"):
        (tmp_path / kind).mkdir()
    for k in range(3):
        pair = render_scene("street", 0, 96, 64, k)
        write_png(tmp_path / "clip" / f"{k}.png", pair.image_ref)
        np.save(tmp_path / "depth" / f"{k}.npy", 7 * pair.truth.depth_ref)
        if k < 2:
            np.save(tmp_path / "flow" / f"{k}.npy", pair.truth.flow)
    keys = {
        "segmentation": {"superpixels": 12, "neighbours": 4},
        "refine": {"enabled": False},
        "solver": {"presolve_iterations": 0, "max_iter": 1},
        "flow": {"source": f"{tmp_path}/flow/*.npy"},
        "depth_prior": {"source": str(tmp_path / "depth"), "kind": "relative"},
    }
    K = pair.K_ref
    camera = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    source = str(tmp_path / "clip")
    chain = soup_nlp.chain(source, tmp_path / "out", frames=3, intrinsics=camera, **keys)
    for k, pair in enumerate(chain.pairs):
        told = pair.summary
        assert told["flow"].startswith("Flow")
        assert told["depth_prior"]
        true = np.load(tmp_path / "flow" / f"{k}.npy")
        known = pair.flow_confidence > 0
        np.testing.assert_allclose(pair.flow[known], true[known], atol=1e-5)
        assert told["sizes"]["superpixels"] == pytest.approx(12, rel=0.3)
    assert (tmp_path / "out" / "pairs" / "000_001" / "log.txt").is_file()
    assert not (tmp_path / "out" / "pairs" / "000_001" / "report.html").exists()
    (tmp_path / "flow" / "1.npy").unlink()
    for more, message in (
        ({"stride": 0}, "unknown stride"),
        ({"stride": 2}, "all frames"),
        ({"frames": 3}, "one for each of 2"),
    ):
        with pytest.raises(SoupError, match=message):
            soup_nlp.chain(source, tmp_path / "more", intrinsics=camera, **{**keys, **more})
    with pytest.raises(ConfigError, match="superpixel"):
        soup_nlp.chain(source, tmp_path / "more", segmentation={"superpixel": 9})
