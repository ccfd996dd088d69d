"""Exported folders: files after one and two exports, broken manifests, tangent coordinates."""

import json
import shutil
from pathlib import Path

import pytest
from test_export import problem_of, write

from benchmarks.family.sol import write_sol
from soup_nlp.cli.main import main
from soup_nlp.errors import ExportError
from soup_nlp.export.foreign import import_sol
from soup_nlp.export.program import file_orders
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.folders import SUMS

pytestmark = pytest.mark.slow


def test_a_second_export_removes_the_files_of_the_first(tmp_path):
    assert write(tmp_path, "--superpixels", "9", "-q") == 0
    (tmp_path / "mine.txt").write_text("not of the export")
    (tmp_path / "manifest.json").write_text("{}")
    # it was changed, so it is the user's now
    assert write(tmp_path, "--superpixels", "12", "-q") == 2
    assert write(tmp_path, "--superpixels", "12", "-q", "--overwrite") == 0
    names = {p.name for p in tmp_path.iterdir()}
    own = {"soup.nl", "soup.col", "soup.row", "problem.yaml", "manifest.json"}
    assert names == own | {"mine.txt", SUMS}


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
        ("fingerprint", []),
        ("fingerprint", ["many", 0.0]),
        ("fingerprint", None),
        ("coordinates", ["matrix"]),
        ("coordinates", "euler"),
        ("exact_energy_at_start", {"total": None}),
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


# --- programs in tangent coordinates --------------------------------------------------------------


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    out = tmp_path_factory.mktemp("tangent")
    assert write(out, "--superpixels", "16", "--coordinates", "tangent") == 0
    return out


def test_an_answer_in_tangent_coordinates_becomes_a_result(exported, tmp_path, capsys):
    case, nlp, layout, order, manifest = problem_of(exported)
    assert manifest["coordinates"] == "tangent"
    # eight rim rays a superpixel and the length unit; SO(3) and unit normals hold by construction
    assert (nlp.nx, nlp.ng) == (9 * len(case), 8 * len(case) + 1)
    energy = case.data, case.weights, case.formulation()
    solved = solve_soup(case.start.soup, *energy, case.options)
    path = tmp_path / "good.sol"
    write_sol(path, layout.pack(solved.soup), None, *order, "elsewhere", 0)
    assert main(["check", str(path), "--export", str(exported)]) == 0
    text = capsys.readouterr().out
    assert "R'R = I" in text
    out = tmp_path / "out"
    assert main(["import", str(exported), str(path), "-o", str(out)]) == 0
    assert main(["check", str(out)]) == 0
    # the same answer to the file with lifted variables
    lifted = tmp_path / "lifted"
    words = ["--superpixels", "16", "--coordinates", "tangent", "--lift"]
    assert write(lifted, *words) == 0
    write_sol(path, layout.pack(solved.soup), None, *file_orders(nlp, lift=True), "elsewhere", 0)
    lines, more = path.read_text().splitlines(), problem_of(lifted)[-1]["lifted"]
    at = lines.index("Options") + 5
    lines[at : at + 4] = [str(nlp.ng + more), "0", *[str(nlp.nx + more)] * 2]
    lines[at + 4 : at + 4] = ["0"] * more
    path.write_text("\n".join(lines))
    assert main(["check", str(path), "--export", str(lifted)]) == 0
    assert main(["check", str(path), "--export", str(exported)]) == 2
    # a point that moves the length unit is refused
    bad = layout.pack(solved.soup)
    bad[::9] *= 1.5
    write_sol(path, bad, None, *order, "elsewhere", 0)
    assert main(["check", str(path), "--export", str(exported)]) == 1
