"""Exported folders: their files after one and two exports, and broken manifests."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import casadi as ca
import h5py
import numpy as np
import pytest
from helpers_nl import ReadBack, close
from test_export import problem_of, write

from soup_nlp.cli.main import main
from soup_nlp.errors import ExportError
from soup_nlp.export.foreign import import_sol
from soup_nlp.export.sol import write_sol
from soup_nlp.storage.folders import MARK

pytestmark = pytest.mark.slow


def test_the_casadi_format_includes_the_start(tmp_path):
    assert write(tmp_path, "--superpixels", "9", "--format", "casadi") == 0
    listed = json.loads((tmp_path / "manifest.json").read_text())["files"]
    assert all((tmp_path / name).is_file() for name in listed)
    _, nlp, _, (v, _), _ = problem_of(tmp_path)
    with h5py.File(tmp_path / "soup.h5") as file:
        given = {k: file[k][:] for k in ("p", "x0", "lbx", "ubx", "lbg", "ubg")}
    for name, values in given.items():
        assert np.array_equal(values, getattr(nlp, name))
    oracle = ca.Function.load(str(tmp_path / "oracle.casadi"))
    back = ReadBack(tmp_path / "soup.nl")
    close(oracle(given["x0"], given["p"])[0], back.values(given["x0"][v])[0])


def test_a_second_export_removes_the_files_of_the_first(tmp_path):
    assert write(tmp_path, "--superpixels", "9", "--format", "casadi", "-q") == 0
    (tmp_path / "mine.casadi").write_text("not of the export")
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    # what no export writes is not removed, even if a manifest lists it
    (tmp_path / "mine.txt").write_text("not of the export")
    manifest["files"] += ["mine.txt", "../outside"]
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    # it was changed, so it is the user's now
    assert write(tmp_path, "--superpixels", "12", "-q") == 2
    assert write(tmp_path, "--superpixels", "12", "-q", "--overwrite") == 0
    names = {p.name for p in tmp_path.iterdir()}
    own = {"soup.nl", "soup.col", "soup.row", "problem.yaml", "manifest.json"}
    assert names == own | {"mine.casadi", "mine.txt", MARK}


def test_sizes_of_equal_number_have_their_own_folders(tmp_path, capsys):
    words = [w for n in ("15", "16", "16") for w in ("--superpixels", n)]
    assert write(tmp_path, *words) == 0
    folders = {p.parent.name for p in tmp_path.rglob("soup.nl")}
    assert folders == {f"orbit-{n}-unit-offset-smooth" for n in (15, 16)}
    assert len(capsys.readouterr().out.splitlines()) == 2
    # two ways to ask for the same formulation
    words = [
        w for f in ("unit-translation", "unit-translation/smooth") for w in ("--formulation", f)
    ]
    assert write(tmp_path / "f", "--superpixels", "9", *words) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1


@pytest.mark.parametrize("name", ["problem.yaml", "manifest.json"])
def test_files_of_the_user_are_not_overwritten(name, tmp_path, capsys):
    (tmp_path / name).write_text("precious")
    assert write(tmp_path, "--superpixels", "9") == 2
    assert f"found: {name}" in capsys.readouterr().err
    assert [p.read_text() for p in tmp_path.iterdir()] == ["precious"]


@pytest.mark.parametrize("count", ["0", "-3"])
def test_a_size_out_of_range_is_refused(count, tmp_path, capsys):
    assert write(tmp_path, "--superpixels", count) == 2
    assert "superpixels" in capsys.readouterr().err
    assert not list(tmp_path.rglob("soup.nl"))


def test_the_start_of_a_presolved_export_is_where_solvers_start(tmp_path, capsys):
    assert write(tmp_path, "--superpixels", "12", "--presolve", "-q") == 0
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    _, _, _, (v, r), _ = problem_of(tmp_path)
    # the case of the folder is prepared without a presolve: its start is in the file
    x = np.empty(len(v))
    x[v] = ReadBack(tmp_path / "soup.nl").x0
    write_sol(tmp_path / "start.sol", x, None, v, r, "start", 400)
    main(["check", str(tmp_path / "start.sol")])
    line = next(s for s in capsys.readouterr().out.splitlines() if s.startswith("energy"))
    value = f"{manifest['exact_energy_at_start']['total']:.6g}"
    assert line == f"energy      start {value}  solution {value}"


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("small")
    assert write(out, "--superpixels", "9", "-q") == 0
    _, nlp, _, (v, r), _ = problem_of(out)
    write_sol(out / "a.sol", nlp.x0, None, v, r)
    return out


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fingerprint", {}),
        ("fingerprint", {"objective": "many", "constraints": 0.0}),
        ("fingerprint", None),
        ("formulation", {"gauge": "unit-offset"}),
        ("formulation", {"gauge": ["unit-offset"], "norm": "smooth", "coordinates": "matrix"}),
        ("formulation", {"gauge": "unit-offset", "norm": "rough", "coordinates": "matrix"}),
        ("smoothing", {"eps": None, "eps_pixel": 1.0}),
        ("exact_energy_at_start", {"total": None}),
        ("nl", []),
        ("best_known", {"found_by": "me"}),
    ],
)
def test_a_broken_manifest_is_refused(key, value, small, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(small, other)
    manifest = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps(manifest | {key: value}))
    with pytest.raises(ExportError, match=f"(?s)cannot be used.*{key}"):
        import_sol(other, other / "a.sol")
    assert main(["check", str(other / "a.sol")]) == 2
    assert "manifest.json" in capsys.readouterr().err
    (other / "manifest.json").write_text("[1]")
    assert main(["check", str(other / "a.sol")]) == 2
