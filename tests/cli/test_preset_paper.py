"""The preset that is the method as printed: its options, its start, its unit, its proposals."""

import re
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks.paper import printed
from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem, load_problem, make_problem
from soup_nlp.config.trees import PRESETS
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.elements import elements
from soup_nlp.model.energy_data import build_energy_data
from soup_nlp.model.layout import TangentLayout
from soup_nlp.model.reweighting import in_translations
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.refine.particles import WALKS, Proposer
from soup_nlp.solve.stages import solve_soup
from soup_nlp.start.epipolar import Matches, Motion
from soup_nlp.start.propose import plane_of

PAPER = {
    # Sec. 4.4.1: "1,000-2,000 superpixels" by SLIC
    "segmentation.superpixels": 1000,
    "segmentation.method": "slic",
    "segmentation.follow_flow_px": None,
    # "a K in the range of 15-20"
    "segmentation.neighbours": 15,
    "start.method": "homography",
    # Eq. 1 to 7: factor 1 of E_arap, the same everywhere; rho and rho_n alone truncate; four terms
    "energy.units": "paper",
    "energy.across": 1.0,
    "energy.weights.prior": 0.0,
    "energy.weights.order": 0.0,
    "energy.weights.sigma_arap": np.inf,
    # t-hat: translations of unit length
    "formulation.gauge": "unit-translation",
    "formulation.min_facing": 0.0,
    # "50 particles ... around the already known beliefs", "5-10 iterations"
    "refine.particles": 50,
    "refine.rounds": 5,
    "refine.stagnation": 0.0,
    "refine.proposals": "walks",
    "refine.photo": 0.0,
}
STREET = {"kind": "scene", "scene": "street", "width": 256, "height": 112}
SMALL = {"input": STREET, "segmentation": {"superpixels": 60, "neighbours": 8}}


def paper(*overrides: str, **fields) -> Problem:
    return make_problem({**SMALL, "preset": "paper", **fields}, overrides)


def test_the_preset_is_what_the_paper_prints():
    problem = make_problem({"input": STREET, "preset": "paper"})
    assert {key: attrgetter(key)(problem) for key in PAPER} == PAPER
    assert 5 <= problem.refine.rounds <= 10
    assert np.isfinite(problem.energy.weights.sigma_cont)
    # E is printed with the factor 1 of E_arap, here 1 / alpha1 times as much: a pixel costs 1
    weights = problem.energy.weights
    assert (weights.arap, weights.proj, weights.cont, weights.orient) == (500.0, 1.0, 15.0, 0.1)


def test_keys_of_the_file_and_overrides_lie_above_the_preset(tmp_path):
    path = tmp_path / "p.yaml"
    path.write_text("preset: paper\ninput: {kind: motorcycle}\nenergy: {weights: {proj: 3.0}}\n")
    problem = load_problem(path, ["refine.rounds=7", "energy.units=pixel"])
    weights = problem.energy.weights
    printed = make_problem({"input": STREET, "preset": "paper"}).energy.weights
    assert (weights.proj, weights.arap, weights.prior) == (3.0, printed.arap, 0.0)
    assert printed.proj != 3.0
    assert (problem.refine.rounds, problem.refine.particles) == (7, 50)
    assert (problem.energy.units, problem.start.method) == ("pixel", "homography")
    assert load_problem(path, ["preset=null"]).refine == Problem(input=problem.input).refine


@pytest.fixture(scope="module")
def case() -> Case:
    """Sixty superpixels of a street with its true flow, as printed."""
    return prepare(paper(flow={"source": "truth"}))


@pytest.mark.slow
def test_the_start_is_one_of_single_superpixels(case):
    """All anchors at one depth; in units of its translation, depth is right where nothing moves."""
    soup, truth = case.start.soup, case.pair.truth
    depth = soup.depth_at(case.data.anchor_ray)
    assert np.allclose(depth, depth[0], rtol=1e-9)
    assert np.ptp(soup.lam * soup.d) > 0
    assert not case.start.component.any()
    u, v = case.segmentation.anchors.round().astype(int).T
    static = truth.components[v, u] == 0

    z = depth / np.linalg.norm(soup.translation, axis=1)
    ratio = (z / truth.depth_ref[v, u])[static]
    # the neighbours' flow is in part of other components
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.3


def test_a_plane_follows_from_its_motion():
    angle = 0.05
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t, m = np.array([0.6, 0.0, 0.8]), np.array([0.02, -0.05, 0.11])
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(0, 0.2, 5)), axis=-1)
    ray = np.column_stack([grid.reshape(-1, 2), np.ones(25)])
    target = ray @ R.T + (ray @ m)[:, None] * t
    matched = Matches(ray, target / target[:, 2:], np.ones(25), 1.0)
    assert np.allclose(plane_of(Motion(R, t), matched), m, atol=1e-9)


@pytest.mark.slow
def test_the_unit_of_length_is_the_sum_of_translations(case):
    """E_cont without truncation is a length: in its unit times the unit it is always the same."""
    start, weights = case.start.soup, case.weights.replace(sigma_cont=np.inf)
    bare = build_energy_data(case.segmentation, case.pair.flow, case.pair.K_ref, case.pair.K_next)
    unit = np.linalg.norm(start.translation, axis=1).sum()
    data = in_translations(bare, start)
    expected = oracle.values("cont", start, bare, weights).sum() * start.distance.mean()
    larger = Soup(2 * start.lam, start.n, start.d, start.R, start.t)
    for soup in (start, larger):
        total = oracle.values("cont", soup, data, weights).sum() * unit
        assert total == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_a_pixel_of_smoothing_is_a_length_and_an_angle(case):
    """In the paper's units the widths of norms are those that eps pixels have on the scene."""
    f, unit = case.data.K_next[0, 0], case.data.edge_unit[0]
    columns = elements(case.data, case.weights, TangentLayout.about(case.soup, case.data))
    arap, cont = columns["arap"].columns, columns["cont"].columns
    assert np.allclose(arap["angle"], 1 / f)
    assert np.allclose(arap["pixel"], 1 / (f * unit))
    assert np.allclose(cont["pixel"], 1 / (f * case.data.pair_unit))


@pytest.mark.slow
def test_the_papers_nlp_has_the_minimum_of_the_presolve(case):
    """Ipopt starts where the presolve ends: with held slopes it started a fifth of E higher."""
    options = case.options.replace(exact_iterations=20, max_iter=0)
    done = solve_soup(case.soup, case.data, case.weights, case.formulation(), options)
    exact, last = done.stages[-2:]
    # one energy of one soup in two sets of variables
    assert last.history["obj"][0] == pytest.approx(exact.objective, rel=1e-7)
    assert done.energy["total"] < 0.5 * done.energy_start["total"]


def test_every_option_of_the_preset_is_in_the_problem():
    problem = {"input": STREET, "preset": "paper"}
    overrides = [f"{key}={value}" for key, value in printed().items()]
    assert make_problem(problem) == make_problem(problem, overrides)


def test_the_documented_departures_that_the_preset_keeps():
    """The table of departures names their keys: the preset sets all but the listed ones."""
    text = (Path(__file__).parents[2] / "docs" / "formulation.md").read_text()
    table = text.split("| in the paper |")[1].split("\n\n")[0]
    keys = set(re.findall(r"`([a-z_]+(?:\.[a-z_]+)+)", table.replace("../soup_nlp", "")))
    assert keys - printed().keys() == {
        "flow.source",
        "energy.pixel_samples",
        "segmentation.boundary_samples",
        "solver.eps",
        "solver.presolve_iterations",
    }


def test_the_command_line_puts_a_preset_below_overrides(capsys, refused):
    assert main(["show", "--preset", "paper"]) == 0
    assert yaml.safe_load(capsys.readouterr().out) == PRESETS["paper"]
    assert main(["show", "street", "--preset", "paper", "--set", "refine.rounds=9"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert (shown["refine"]["rounds"], shown["refine"]["particles"]) == (9, 50)
    assert "show" in refused("show")
    for words in (["--preset", "papr"], ["street", "--preset", "papr"]):
        assert "paper" in refused("show", *words)


def test_walks_are_the_only_proposals_of_the_paper(case, monkeypatch):
    drawn, propose = set(), Proposer.propose

    def recorded(self, soup, kind, count):
        drawn.add(kind)
        return propose(self, soup, kind, count)

    monkeypatch.setattr(Proposer, "propose", recorded)
    options = case.problem.refine.replace(rounds=2, particles=8)
    done = refine_soup(
        case.start.soup, case.data, case.weights, options, min_facing=0.0, depth_ratio=1e6
    )
    assert drawn == set(WALKS)
    assert done.energy["total"] <= done.energy_begin["total"]
