"""Instances of the family: their names and their NLPs, which are equal on every processor.

Superpixels, start and presolve involve search or iteration. They were computed once, and their
results are records (`frozen`). The rest is rendering and arithmetic, whose last bits
depend on the processor. Every number of the NLP is therefore rounded to 20 significant bits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np

from benchmarks.family.frozen import Frozen
from soup_nlp.arrays import Float
from soup_nlp.data.pair import Pair
from soup_nlp.errors import ConfigError
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData, build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Layout, TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_tangent_nlp, exact_chart
from soup_nlp.model.reweighting import in_pixels
from soup_nlp.pipeline.case import segmented, solver_options
from soup_nlp.pipeline.record import Case
from soup_nlp.start.labelling import limited_noise
from soup_nlp.start.propose import Start

VERSION = 4
"""Version of the family; instances of one version have the same bytes everywhere."""
SCENES = ("orbit", "street", "room", "sheet")
SIZES = (100, 250, 500, 1000, 2000)
"""Wanted numbers of superpixels."""
STARTS = ("easy", "hard", "cold")
STANDARD = "unit-offset/smooth"
"""Default formulation of the family."""
FORMULATIONS: Mapping[str, Mapping[str, str]] = {
    STANDARD: {"gauge": "unit-offset"},
    "unit-translation/smooth": {"gauge": "unit-translation"},
    "tangent/smooth": {"coordinates": "tangent"},
}
"""What differs from the problem of a record."""
BITS = 20
"""Significant bits of every number of an instance."""
MIN_EXPONENT = -30
"""Exponent of the smallest rounding step, a power of 2: small differences are inexact."""
ROUND_UP_FROM = 0.381966011250105
"""Position in a step at which rounding goes up; not 1/2, where exact data may be."""


@dataclass(frozen=True)
class Instance:
    """An instance of the family.

    Attributes:
        scene: One of SCENES.
        formulation: One of FORMULATIONS.
        size: Wanted number of superpixels, one of SIZES; the actual number may differ a little.
        start: easy (Ipopt's answer), hard (the proposal) or cold (constant depth, true flow).
    """

    scene: str
    formulation: str
    size: int
    start: str

    @property
    def name(self) -> str:
        """`SOUP-<scene>-<formulation>-N<size>-<start>`."""
        return f"{self.problem}-{self.start}"

    @property
    def problem(self) -> str:
        """The name without the start."""
        return f"SOUP-{self.scene}-{self.formulation.replace('/', '-')}-N{self.size}"


def parse_name(name: str) -> Instance:
    """The instance of a name; a name without start gets the first start."""
    for instance in select(SIZES, SCENES, [*FORMULATIONS]):
        if name in (instance.name, instance.problem):
            return instance
    raise ConfigError(
        "no instance of the family",
        found=name,
        expected="SOUP-SCENE-GAUGE-NORM-NSIZE-START",
        hint="such as SOUP-street-unit-offset-smooth-N100-easy",
    )


def select(
    sizes: Sequence[int],
    scenes: Sequence[str],
    forms: Sequence[str],
    starts: Sequence[str] = STARTS,
) -> list[Instance]:
    """Instances of sizes, scenes, formulations and starts."""
    known = {
        "sizes": (sizes, SIZES),
        "scenes": (scenes, SCENES),
        "formulation": (forms, FORMULATIONS),
        "starts": (starts, STARTS),
    }
    for name, (asked, members) in known.items():
        wrong = ", ".join(str(a) for a in asked if a not in members)
        if wrong or not len(asked):
            found, expected = wrong or "nothing", ", ".join(map(str, members))
            raise ConfigError(
                "not of the family", where=f"--{name}", found=found, expected=expected
            )
    chosen = product(scenes, forms, sizes, starts)
    return [*dict.fromkeys(Instance(*parts) for parts in chosen)]


def case_of(record: Frozen, pair: Pair | None = None) -> Case:
    """The case of a record, with graphs and weights; its pair may have been rendered before."""
    problem = record.problem
    pair = pair or problem.load_pair()
    pair = pair.with_flow(problem.flow.load(pair, problem.path))
    seg = replace(segmented(problem, pair, record.labels), pair_weight=record.pair_weight)
    # entries that the energy does not use are 0
    none = np.zeros(len(seg), np.int64)
    start = Start(
        soup=record.start,
        error=record.error,
        parallax=none.astype(float),
        interpolated=none.astype(bool),
        motion=none,
        component=record.component,
        part=record.component,
        motions=[],
        covariance=np.zeros((0, 5, 5)),
        surface=record.surface,
        origin=none,
        bends=np.full(len(seg), record.bending),
        unexplained=none.astype(bool),
        wrong=none.astype(bool),
        # records of bending surfaces have their prior in pixels
        noise=1.0 if record.bending else limited_noise(record.error),
    )
    options, energy = solver_options(problem, start), problem.energy
    pixels = None if energy.pixel_samples == "all" else energy.pixel_samples
    assert pair.flow is not None
    cameras = pair.K_ref, pair.K_next
    data = build_energy_data(seg, pair.flow, *cameras, pixels, problem.seed, record.bending)
    data = replace(
        in_pixels(data, start.soup, seg, start.bends),
        edge_weight=record.edge_share * data.edge_weight,
        pair_weight=record.pair_share * data.pair_weight,
        orient_weight=record.orient_share * data.orient_weight,
        prior_weight=record.prior_weight,
    )
    values = {f.name: np.asarray(getattr(data, f.name)) for f in fields(data)}
    reals: dict[str, Any] = {k: rounded(v) for k, v in values.items() if v.dtype == np.float64}
    data = replace(data, **reals)
    weights = record.weights(Weights(**dict(energy.weights)))
    return Case(problem, pair, seg, start, data, weights, start.soup, options)


def build_instance(
    case: Case, record: Frozen, formulation: str, start: str
) -> tuple[NLP, Layout, Formulation]:
    """The NLP of a formulation at a start, its layout and its formulation.

    The formulation is one of FORMULATIONS, the start one of STARTS, or "best": the best known point
    without rounding.
    """
    form = case.formulation(**FORMULATIONS[formulation], hessian="exact")
    soups = {"easy": record.best, "hard": record.start, "best": record.best}
    soup = constant_depth(case.data) if start == "cold" else soups[start]
    nlp, layout = _program(case, record, soup, form)
    x0 = nlp.x0 if start == "best" else rounded(nlp.x0)
    nlp = replace(nlp, x0=np.clip(x0, nlp.lbx, nlp.ubx))
    return nlp, layout, form


def _program(case: Case, record: Frozen, soup: Soup, form: Formulation) -> tuple[NLP, Layout]:
    """The NLP at a soup. The base of tangent coordinates is the record's start, rounded where it
    may be: its rotations stay orthogonal, as they are decoded."""
    if form.coordinates == "matrix":
        return replace(case, soup=soup).nlp(form)
    data, start = case.data, record.start.normalised(case.data.share)
    depth = rounded(start.depth_at(data.anchor_ray))
    shift = rounded(start.translation / depth[:, None])
    about = data.anchor_ray, data.radius, data.share, depth, record.start.R, shift
    base = TangentLayout(*about, exact_chart(data))
    nlp, layout = build_tangent_nlp(soup, data, case.weights, form, layout=base)
    unit = [
        replace(g, data=rounded(g.data)) if g.kernel.name == "t_simplex" else g for g in nlp.groups
    ]
    return replace(nlp, groups=tuple(unit)), layout


def rounded(values: Float) -> Float:
    """Numbers rounded to BITS significant bits, which removes bits that depend on the processor.

    The step is a power of 2 and therefore exact. Two values with a relative difference of d = 1e-15
    are rounded differently with a probability of about 2 ** BITS * d = 1e-9.
    """
    values = np.asarray(values, float)
    exponent = np.frexp(np.where(np.isfinite(values), values, 0.0))[1]
    step = np.ldexp(1.0, np.maximum(exponent - BITS, MIN_EXPONENT))
    # multiples of the step do not change, since the shift is less than a step
    exact = np.floor(values / step + (1 - ROUND_UP_FROM)) * step
    return np.where(np.isfinite(values), exact, values)


def constant_depth(data: EnergyData) -> Soup:
    """Fronto-parallel planes at one depth, translated by their mean flow, without rotation."""
    n = len(data)
    target = np.add.reduce(data.pixel_target, axis=1) / data.pixel_target.shape[1]
    source = np.add.reduce(data.pixel_ray, axis=1) / data.pixel_ray.shape[1]
    K = data.K_next
    shift = np.zeros((n, 3))
    shift[:, :2] = (target - K[:2, 2]) / np.diag(K)[:2] - source[:, :2]
    normal, still = np.tile([0.0, 0.0, -1.0], (n, 1)), np.tile(np.eye(3), (n, 1, 1))
    return Soup(np.ones(n), normal, np.ones(n), still, shift)
