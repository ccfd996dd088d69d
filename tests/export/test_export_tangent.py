"""Programs in tangent coordinates: exported, read back, and answered like those in matrices."""

from __future__ import annotations

import numpy as np
import pytest
from test_export import problem_of, write
from test_nl import ReadBack, close

from soup_nlp.cli.main import main
from soup_nlp.errors import ConfigError
from soup_nlp.export.artefact import parse_formulations
from soup_nlp.export.sol import write_sol
from soup_nlp.family.frozen import load_frozen
from soup_nlp.family.instances import build_instance, case_of, parse_name
from soup_nlp.model import oracle
from soup_nlp.model.layout import TangentLayout
from soup_nlp.solve.stages import solve_soup

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    out = tmp_path_factory.mktemp("tangent")
    assert write(out, "--superpixels", "16", "--coordinates", "tangent", "--format", "casadi") == 0
    return out


def test_the_file_has_nine_coordinates_and_the_energy_of_the_soup(exported):
    case, nlp, layout, (v, r), manifest = problem_of(exported)
    assert isinstance(layout, TangentLayout)
    assert manifest["formulation"]["coordinates"] == "tangent"
    n = len(case)
    # eight rim rays a superpixel and the length unit; SO(3) and unit normals hold by construction
    assert (nlp.nx, nlp.ng) == (9 * n, 8 * n + 1)
    back = ReadBack(exported / "soup.nl")
    close(back.x0, nlp.x0[v])
    rng = np.random.default_rng(0)
    x = nlp.x0 + 0.01 * rng.standard_normal(nlp.nx)
    here, rows, *_ = back.values(x[v])
    close(here, nlp.value(x))
    close(np.asarray(rows).ravel(), nlp.constraints(x)[r])
    # up to the smoothing, f is E of the soup that the vector stands for
    sharp, _ = case.nlp(
        case.formulation(coordinates="tangent", compiled=False, eps=1e-9, eps_pixel=1e-9)
    )
    value = sharp.value(sharp.x0)
    E = oracle.energy(layout.unpack(sharp.x0), case.data, case.weights)["total"]
    assert value == pytest.approx(E, rel=0.05)


def test_an_answer_in_tangent_coordinates_becomes_a_result(exported, tmp_path, capsys):
    case, _nlp, layout, order, _ = problem_of(exported)
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
    # a point that moves the length unit is refused
    bad = layout.pack(solved.soup)
    bad[::9] *= 1.5
    write_sol(path, bad, None, *order, "elsewhere", 0)
    assert main(["check", str(path), "--export", str(exported)]) == 1


def test_the_start_does_not_change_the_program():
    record = load_frozen("street", 100)
    case = case_of(record)
    built = {}
    for start in ("easy", "hard", "cold"):
        name = f"SOUP-street-tangent-smooth-N100-{start}"
        built[start] = build_instance(case, record, parse_name(name).formulation, start)
    first, layout, _ = built["hard"]
    for nlp, other, _ in built.values():
        assert np.array_equal(nlp.p, first.p)
        assert np.array_equal(other.R0, layout.R0)
    # and the best known point is that of the matrices
    tangent, _, _ = build_instance(case, record, "tangent/smooth", "best")
    matrix, _, _ = build_instance(case, record, "unit-offset/smooth", "best")
    f, m = (p.value(p.x0) for p in (tangent, matrix))
    assert f == pytest.approx(m, rel=1e-9)


def test_tangent_coordinates_have_no_gauge():
    assert parse_formulations(None, "tangent") == [{"coordinates": "tangent"}]
    assert parse_formulations(["tangent/epigraph"], "matrix") == [
        {"coordinates": "tangent", "norm": "epigraph"}
    ]
    with pytest.raises(ConfigError, match="gauge"):
        parse_formulations(["unit-offset"], "tangent")
    with pytest.raises(ConfigError, match="coordinates"):
        parse_formulations(None, "euler")
