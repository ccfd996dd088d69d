"""The constraints of the NLP as a specification, and how far Ipopt's raw answer is from them.

Everything is recomputed in plain numpy from the solver's vector by the names of its numbers. The
vector counts scales as `N lam` and lengths in `1 / N`:

    kind          rows                          gauges
    so3           6 per superpixel, R'R = I     all
    normal        1 per superpixel, |n|^2 = 1   all
    visible       anchor and rim, -n . v >= c   all; v = r_a, then r_rim - r_a / depth_ratio
    simplex       1, sum lam = 1                all
    unit          1, sum c lam d = 1            unit-translation; else d = 1 / c is no variable
    translation   1 per superpixel, |t| = tau   unit-translation

`tests/tools/constraint_mutants.py` deletes each of these and each bound, and runs this file.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_model import GAUGES, PAPER, UNITS, disturbed, form, tiny, weights_for, wiggle, world

from soup_nlp.config.problem import load_problem
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import MatrixLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_matrix_nlp, build_tangent_nlp
from soup_nlp.pipeline.case import prepare
from soup_nlp.solve.ipopt import run_ipopt
from soup_nlp.solve.stages import solve_soup

ENTRIES = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]
"""Of R'R, in the order of the rows."""
BOUNDS = {
    "lam": (1e-4, np.inf),
    "d": (1e-4, np.inf),
    "tau": (1e-8, np.inf),
    "n": (-np.inf, np.inf),
    "R": (-np.inf, np.inf),
    "t": (-np.inf, np.inf),
}
"""Bounds of the variables."""
RAW = 1e-8
"""Largest violation of the raw answer, by any kind. Ipopt's own tolerance is 1e-9."""


# --- the specification in numpy -----------------------------------------------------------------


def kind_of(name: str) -> str:
    """`so3[17]` -> so3."""
    return name.partition("[")[0]


def numbers(nlp: NLP, x: np.ndarray) -> SimpleNamespace:
    """The soup's variables by name: lam (N,), n (N, 3), R (N, 3, 3), t (N, 3); d, tau if any."""
    at = dict(zip(nlp.x_names(), x))
    count = sum(name.startswith("lam[") for name in at)
    each = [(i, r) for i in range(count) for r in (1, 2, 3)]
    return SimpleNamespace(
        lam=np.array([at[f"lam[{i}]"] for i in range(count)]),
        n=np.array([at[f"n[{i},{r}]"] for i, r in each]).reshape(-1, 3),
        t=np.array([at[f"t[{i},{r}]"] for i, r in each]).reshape(-1, 3),
        R=np.array([at[f"R[{i},{r},{c}]"] for i, r in each for c in (1, 2, 3)]).reshape(-1, 3, 3),
        d=np.array([at[f"d[{i}]"] for i in range(count)]) if "d[0]" in at else None,
        tau=at.get("tau"),
    )


def bodies(nlp: NLP, x: np.ndarray, data: EnergyData, depth_ratio: float) -> dict[str, np.ndarray]:
    """What the rows of every kind have to be."""
    v = numbers(nlp, x)
    gram = np.einsum("nji,njk->nik", v.R, v.R) - np.eye(3)
    anchor, rim = data.rim_ray[:, :1], data.rim_ray[:, 1:]
    rays = np.concatenate([anchor, rim - anchor / depth_ratio], axis=1)
    out = {
        "so3": np.stack([gram[:, i, k] for i, k in ENTRIES], axis=1).ravel(),
        "normal": np.sum(v.n**2, axis=1) - 1,
        "visible": -np.einsum("nc,nvc->nv", v.n, rays).ravel(),
        "simplex": np.array([v.lam.mean()]),
    }
    if v.d is not None:
        out["unit"] = np.array([np.sum(data.share * v.lam * v.d)])
    if v.tau is not None:
        out["translation"] = np.sum(v.t**2, axis=1) - v.tau**2
    return out


def limits(kind: str, min_facing: float) -> tuple[float, float]:
    """Bounds of the rows of a kind."""
    return {"visible": (min_facing, np.inf), "simplex": (1.0, 1.0), "unit": (1.0, 1.0)}.get(
        kind, (0.0, 0.0)
    )


def rows(nlp: NLP, kind: str) -> np.ndarray:
    """(ng,) which rows are of a kind."""
    return np.array([kind_of(name) == kind for name in nlp.g_names()])


def violations(nlp: NLP, x: np.ndarray, data: EnergyData, f: Formulation) -> dict[str, float]:
    """Largest violation by kind of a raw vector, bounds and the sign of det R among them."""
    out = {"det": float(np.abs(np.linalg.det(numbers(nlp, x).R) - 1).max())}
    found = bodies(nlp, x, data, f.depth_ratio)
    for kind, body in found.items():
        lower, upper = limits(kind, f.min_facing)
        out[kind] = float(np.maximum(lower - body, body - upper).max(initial=0.0))
    for name, v in zip(nlp.x_names(), x):
        lower, upper = BOUNDS[kind_of(name)]
        key = f"bound of {kind_of(name)}"
        out[key] = max(out.get(key, 0.0), lower - v, v - upper)
    return out


# --- every row and every bound, in every formulation --------------------------------------------


@pytest.mark.parametrize("gauge", GAUGES)
def test_every_row_and_every_bound_is_the_specified_one(gauge):
    problem, share = tiny("pixels"), np.linspace(1.0, 4.0, 12)
    data = replace(problem.data, share=share / share.sum())
    f = form(gauge=gauge, depth_ratio=4.0, min_facing=0.02)
    nlp, _ = build_matrix_nlp(problem.soup, data, weights_for("pixels"), f)
    # the start is feasible
    assert np.isfinite(nlp.x0).all()
    found = violations(nlp, nlp.x0, data, f)
    assert max(found.values()) <= 1e-9, found
    # off the manifold, where no entry of any row is 0
    x = wiggle(nlp, 1, 0.3)
    spec, g = bodies(nlp, x, data, 4.0), nlp.constraints(x)
    kinds = {kind_of(name) for name in nlp.g_names()}
    assert kinds == spec.keys()
    for kind, body in spec.items():
        np.testing.assert_allclose(g[rows(nlp, kind)], body, rtol=0, atol=1e-12, err_msg=kind)
        assert np.abs(body - limits(kind, 0.02)[0]).min() > 1e-6, kind
    for kind in kinds:
        lower, upper = limits(kind, 0.02)
        assert (nlp.lbg[rows(nlp, kind)] == lower).all(), kind
        assert (nlp.ubg[rows(nlp, kind)] == upper).all(), kind
    for name, lower, upper in zip(nlp.x_names(), nlp.lbx, nlp.ubx):
        assert (lower, upper) == BOUNDS[kind_of(name)], name


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("chart", ["depth", "inverse-depth"])
def test_the_presolve_constrains_scale_and_visibility_only(chart, units):
    problem = tiny(units)
    f = form(depth_ratio=4.0, min_facing=0.02)
    nlp, layout = build_tangent_nlp(problem.soup, problem.data, PAPER, f, chart)
    assert {kind_of(name) for name in nlp.g_names()} == {"simplex", "visible"}
    rng = np.random.default_rng(0)
    x = (nlp.x0.reshape(-1, 9) * rng.uniform(0.9, 1.1, (12, 9))).ravel()
    a, g = x.reshape(-1, 9), nlp.constraints(x)
    scale = a[:, 0] if chart == "depth" else 1 / a[:, 0]
    # planes of the coordinates, and the visibility of the constrained NLP in units of the facing
    m = np.column_stack([a[:, 1:3] / layout.radius[:, None], np.zeros(12)])
    m[:, 2] = (1.0 if chart == "depth" else a[:, 0]) - np.sum(m * layout.anchor, axis=1)
    rays = problem.data.visibility_ray(4.0)[:, 1:]
    facing = np.einsum("nc,nvc->nv", m, rays) - 0.02 * np.linalg.norm(m, axis=1)[:, None]
    np.testing.assert_allclose(g[rows(nlp, "visible")], facing.ravel(), atol=1e-12)
    part = problem.soup.normalised(layout.share).lam
    if units == "paper" and chart == "depth":
        part = layout.share * layout.depth / np.linalg.norm(m, axis=1)
    np.testing.assert_allclose(g[rows(nlp, "simplex")], [np.sum(part * scale)], atol=1e-12)
    for kind, (lower, upper) in {"simplex": (1.0, 1.0), "visible": (0.0, np.inf)}.items():
        assert (nlp.lbg[rows(nlp, kind)] == lower).all()
        assert (nlp.ubg[rows(nlp, kind)] == upper).all()
    lower, upper = nlp.lbx.reshape(-1, 9), nlp.ubx.reshape(-1, 9)
    assert (lower[:, 0] == 1e-3).all()
    assert (lower[:, 1:3] == -80).all()
    assert (upper[:, 1:3] == 80).all()
    free = np.concatenate([-lower[:, 3:].ravel(), upper[:, 3:].ravel(), upper[:, 0]])
    assert np.isposinf(free).all()


# --- what the constraints mean ------------------------------------------------------------------


@pytest.mark.parametrize("chart", ["depth", "inverse-depth"])
def test_the_start_of_the_presolve_is_feasible(chart):
    problem = tiny("pixels")
    own = problem.data, weights_for("pixels"), form()
    nlp, base = build_tangent_nlp(problem.soup, *own, chart)
    g = nlp.constraints(nlp.x0)
    assert g[nlp.g_names().index("simplex")] == pytest.approx(1.0, abs=1e-12)
    assert np.maximum(nlp.lbg - g, g - nlp.ubg).max() <= 1e-9
    assert ((nlp.lbx <= nlp.x0) & (nlp.x0 <= nlp.ubx)).all()
    # too steep a soup at other depths starts about as steep as the rows of visibility admit
    steep = np.random.default_rng(0).uniform([0.5, 2, 2, *[0] * 6], [2, 4, 4, *[0] * 6], (12, 9))
    nlp, _ = build_tangent_nlp(base.unpack(steep), *own, layout=base)
    rho = nlp.x0[::9] if chart == "inverse-depth" else np.ones(12)
    least = nlp.constraints(nlp.x0)[rows(nlp, "visible")].reshape(12, -1).min(axis=1) / rho
    assert 0 <= least.min() <= least.max() <= 0.1


# --- the raw answer of Ipopt --------------------------------------------------------------------

WEIGHTS = PAPER.replace(cont=0.05, prior=0.05, sigma_cont=6.0, sigma_orient=5.0, sigma_arap=12.0)
WIDE = {"eps": 1.0, "eps_pixel": 1.0}
"""Smoothing of a pixel: a few iterations from a disturbed start."""


@cache
def smooth_answer(name: str, gauge: str, ratio: float) -> tuple[NLP, MatrixLayout, np.ndarray]:
    """NLP, layout and raw answer from a disturbed start."""
    soup, data = world(name, "pixels", False)
    f = form(gauge=gauge, depth_ratio=ratio, **WIDE)
    nlp, layout = build_matrix_nlp(disturbed(soup, 0.02), data, WEIGHTS, f)
    stage = run_ipopt(nlp, x0=nlp.x0, tol=1e-3)
    assert stage.converged, stage
    # it had something to do
    assert stage.iterations >= 3
    return nlp, layout, stage.x


@pytest.mark.parametrize(
    ("name", "gauge", "ratio"),
    [
        ("slanted", "unit-offset", 5.0),
        pytest.param("slanted", "unit-translation", 5.0, marks=pytest.mark.slow),
        pytest.param("slanted", "unit-offset", 1.05, marks=pytest.mark.slow),
        pytest.param("fronto-parallel, turning", "unit-translation", 5.0, marks=pytest.mark.slow),
    ],
)
def test_the_raw_answer_keeps_every_constraint(gauge, name, ratio):
    nlp, layout, x = smooth_answer(name, gauge, ratio)
    _, data = world(name, "pixels", False)
    f = form(gauge=gauge, depth_ratio=ratio)
    found = violations(nlp, x, data, f)
    assert max(found.values()) <= RAW, found
    # so narrow a visibility holds planes back that slant
    facing = nlp.constraints(x)[rows(nlp, "visible")] - f.min_facing
    assert (facing.min() < 1e-4) == (ratio == 1.05)
    # what is delivered is the answer itself: the retraction moves it by no more
    soup = layout.unpack(x)
    kept = soup.normalised(data.share).retracted()
    np.testing.assert_allclose(kept.R, soup.R, atol=RAW)
    np.testing.assert_allclose(kept.n, soup.n, atol=RAW)


@pytest.mark.parametrize("side", ["lbx", "ubx", "lbg", "ubg"])
def test_ipopt_gets_every_kind_of_bound(side):
    """A bound that its own answer violates moves the answer to the bound."""
    nlp, _, x = smooth_answer("slanted", "unit-offset", 5.0)
    sign = 1 if side.startswith("l") else -1
    if side.endswith("x"):
        k = nlp.x_names().index("lam[3]")
        free, rest = x[k], nlp
    else:
        k = int(np.flatnonzero(rows(nlp, "visible"))[10])
        free, rest = (
            nlp.constraints(x)[k],
            replace(nlp, ubg=np.where(nlp.lbg < nlp.ubg, 2.0, nlp.ubg)),
        )
    bound = getattr(rest, side).copy()
    bound[k] = free + sign * 0.01
    stage = run_ipopt(replace(rest, **{side: bound}), x0=x, tol=1e-3)
    found = stage.x[k] if side.endswith("x") else nlp.constraints(stage.x)[k]
    assert stage.converged, stage
    assert found == pytest.approx(bound[k], abs=1e-3)
    assert sign * (found - bound[k]) >= -RAW


def unseen(nlp: NLP, x: np.ndarray) -> np.ndarray:
    """(N,) whether any visibility row of a superpixel is violated."""
    visible = rows(nlp, "visible")
    return (nlp.constraints(x) < nlp.lbg)[visible].reshape(12, -1).any(axis=1)


@pytest.mark.parametrize("ratio", [2.0, 5.0])
def test_visibility_bounds_the_depth_over_a_superpixel(ratio):
    """A plane that the constrained NLP or the presolve admits is nowhere too steep."""
    problem, rng = tiny(), np.random.default_rng(0)
    f = form(depth_ratio=ratio)
    nlp, layout = problem.nlp(PAPER, f)
    pre, tangent = build_tangent_nlp(problem.soup, problem.data, PAPER, f)
    rim = problem.data.rim_ray
    admitted = 0
    for _ in range(60):
        n = rng.normal(0, 1, (12, 3)) * [4, 4, 1]
        n /= -np.sign(n[:, 2:]) * np.linalg.norm(n, axis=1, keepdims=True)
        soup = replace(problem.soup, n=n)
        facing = -np.einsum("nc,nvc->nv", n, rim)
        steep = (facing[:, 1:] <= facing[:, :1] / ratio).any(axis=1) | (facing <= 0).any(axis=1)
        bad = unseen(nlp, layout.pack(soup))
        assert (bad[facing[:, 0] > 0] >= steep[facing[:, 0] > 0]).all()
        assert bad[facing[:, 0] <= 0].all()
        admitted += int((~bad).sum())
        # the presolve admits no more than the constrained NLP
        sees = (facing > 0).all(axis=1)
        other = unseen(pre, tangent.pack(replace(soup, n=np.where(sees[:, None], n, [0, 0, -1.0]))))
        assert (other[sees] >= bad[sees]).all()
    assert admitted > 30


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "gauge"), [("room", "unit-offset"), ("street", "unit-translation")]
)
def test_the_raw_answer_of_a_default_solve_keeps_every_constraint(scene, gauge):
    small = ["input.width=96", "input.height=72", "segmentation.superpixels=20"]
    own = [f"formulation.gauge={gauge}", "flow.source=truth"]
    case = prepare(load_problem(scene, [*small, *own]))
    f = case.formulation()
    solution = solve_soup(case.soup, case.data, case.weights, f, case.options)
    assert solution.converged, solution.status
    nlp, _ = case.nlp(f)
    found = violations(nlp, solution.stages[-1].x, case.data, f)
    assert max(found.values()) <= RAW, found
    assert solution.residuals["nlp_infeasibility"] <= RAW
