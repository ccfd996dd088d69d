"""Declared studies and departures of the paper's page, and the numbers that the paper prints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from soup_nlp.bench.study import Overrides
from soup_nlp.config.presets import as_override, overrides_of
from soup_nlp.config.problem import make_problem

SOURCE = "Superpixel Soup (Kumar, Dai, Li, TPAMI), table of the performance comparison"
NOISE_PX = ("0.1", "0.5", "1", "2")
"""Standard deviations of the noise on true flow, pixels."""


def without(*terms: str) -> Overrides:
    """Overrides that switch off terms of the energy."""
    return tuple(f"energy.weights.{t}=0.0" for t in terms)


def over(key: str, values: Sequence[object]) -> dict[str, Overrides]:
    """Variants of one option, named by its values."""
    return {str(v): (f"{key}={v}",) for v in values}


@dataclass(frozen=True)
class Study:
    """Variants of the options that are measured on the same pairs.

    Attributes:
        text: The question.
        variants: Overrides by name of a variant, in the order of the tables.
        published: Result in the paper.
    """

    text: str
    variants: Mapping[str, Overrides]
    published: str = ""


STUDIES: Mapping[str, Study] = {
    "ablation": Study(
        "what each term of the energy adds (the paper's ablation table)",
        {
            "arap": without("proj", "cont", "orient", "prior"),
            "+ proj": without("cont", "orient", "prior"),
            "+ cont": without("orient", "prior"),
            "+ orient": without("prior"),
            "+ prior": (),
        },
    ),
    "superpixels": Study(
        "number of superpixels",
        over("segmentation.superpixels", (100, 250, 500, 1000, 2000)),
        "Published as a figure: the error hardly falls beyond 1,000 superpixels.",
    ),
    "neighbours": Study(
        "K of the K-NN graph",
        over("segmentation.neighbours", (4, 8, 12, 15, 20)),
        "Published as pictures of one pair (K = 4 and 20); K from 15 to 20 is used.",
    ),
    "pattern": Study(
        "SLIC against a regular grid",
        over("segmentation.method", ("slic", "grid")),
        "Published for one frame with 1,000 superpixels: slic 0.0912, grid 0.1442. Copied, not"
        f" measured: {SOURCE}.",
    ),
    "flow": Study(
        "flow: the truth, the truth with noise of 0.1 to 2 pixels, DIS",
        over("flow.source", ["truth", *(f"truth+noise:{px}" for px in NOISE_PX), "dis"]),
        "Published as a figure of RMSE in metres on Sintel.",
    ),
    "stages": Study(
        "NLP and refinement, alone and together",
        {
            "NLP": ("refine.enabled=false",),
            "refinement": ("refine.from_start=true",),
            "both": (),
        },
    ),
}
"""Studies by name."""


# --- departures of the defaults from the paper ----------------------------------------------------
#
# A departure is a group of options in which the defaults and `preset: paper` differ. "Off alone"
# means the defaults with the paper's values of the group. "On alone" means the preset with the
# default values of the group.

PAPER = ("preset=paper",)


@dataclass(frozen=True)
class Departure:
    """A group of options.

    Attributes:
        name: Title of its row.
        keys: Dotted names of the options.
        with_off: Further overrides that "off alone" needs.
        with_on: Further overrides that "on alone" needs.
        needs: Explanation of the further overrides, for the table.
    """

    name: str
    keys: tuple[str, ...] = ()
    with_off: Overrides = ()
    with_on: Overrides = ()
    needs: str = ""

    def off_alone(self) -> Overrides:
        """Overrides of the defaults for "off alone"."""
        printed = {o.partition("=")[0]: o for o in overrides_of("paper")}
        return (*(printed[key] for key in self.keys), *self.with_off)

    def on_alone(self) -> Overrides:
        """Overrides of the preset for "on alone"."""
        return (*_defaults(*self.keys), *self.with_on)


def default(key: str) -> Any:
    """The default of an option."""
    return attrgetter(key)(make_problem({"input": {"kind": "motorcycle"}}))


def _defaults(*keys: str) -> Overrides:
    return tuple(as_override(key, default(key)) for key in keys)


_IN_PIXELS = (
    "energy.units",
    *(f"energy.weights.{w}" for w in ("arap", "proj", "cont", "orient", "sigma_cont")),
)
_ADDED = tuple(f"energy.weights.{w}" for w in ("prior", "sigma_arap", "leak_arap"))
_DENSE = ("energy.pixel_samples=64", "segmentation.boundary_samples=12")
_SMALL = ("max_size=0.05",)
_SHARED = ("start.method=shared",)
_FINDS = "on: with the start that finds components"

DEPARTURES = (
    Departure(
        "start: shared motions, scales by contact",
        ("start.method", "start.samples", "start.threshold_px", "start.ground"),
    ),
    Departure(
        "pixel units and their weights",
        _IN_PIXELS,
        # a truncation given in pixels has no meaning in the paper's units
        with_off=("energy.weights.sigma_arap=.inf",),
        needs="off: E_arap not truncated, since its truncation is in pixels",
    ),
    Departure(
        "E_arap truncated with a leak",
        ("energy.weights.sigma_arap", "energy.weights.leak_arap"),
        with_on=("energy.weights.sigma_arap=1e-3",),
        needs="on: at 0.001 in the paper's units",
    ),
    Departure(
        "E_arap and E_prior weak across components",
        ("energy.arap_across",),
        with_on=_SHARED,
        needs=_FINDS,
    ),
    Departure("E_arap joins the scene", ("energy.arap_scene",), with_on=_SHARED, needs=_FINDS),
    Departure(
        "E_cont weak at occlusions", ("energy.cont_occluded",), with_on=_SHARED, needs=_FINDS
    ),
    Departure(
        "another energy where surfaces bend",
        ("start.bending",),
        with_on=(*_SHARED, *_defaults(*_IN_PIXELS, *_ADDED)),
        needs="on: with the start that finds them, pixel units and all weights",
    ),
    Departure("prior on relief", ("energy.weights.prior",)),
    Departure(
        "depth prior", ("energy.weights.depth",), needs="a file: without one it has no elements"
    ),
    Departure("order by occlusion", ("energy.weights.order",), with_on=_SHARED, needs=_FINDS),
    Departure("borders that follow the flow", ("segmentation.follow_flow_px",)),
    Departure("confidence of the flow", ("flow.consistency",)),
    Departure("flow seen through reflections", ("flow.see_through",)),
    Departure(
        "large images at a working size",
        ("max_size",),
        with_off=_SMALL,
        with_on=_SMALL,
        needs="on in both, at 0.05 megapixels: no pair here is larger than the limit",
    ),
    Departure(
        "samples of pixels and boundaries",
        with_off=_DENSE,
        with_on=_DENSE,
        needs="off in both: 64 pixels a superpixel, 12 points a boundary (default 16 and 3)",
    ),
    Departure("gauge: d constant", ("formulation.gauge",)),
    Departure("visibility", ("formulation.min_facing", "formulation.depth_ratio")),
    Departure(
        "stages before the constrained NLP",
        with_off=("solver.presolve=false",),
        with_on=("solver.presolve=false",),
        needs="off in both; the preset has it, since it is a way to the minimum of the same energy",
    ),
    Departure("proposals beyond walks, depths within reach", ("refine.proposals",)),
    Departure("rounds end early", ("refine.rounds", "refine.stagnation")),
    Departure("images in the refinement", ("refine.photo",)),
)
"""Every departure that options can undo; a test checks for missing ones."""


# --- mean relative errors printed in the paper, copied: none is measured --------------------------

_PUBLISHED: Mapping[str, tuple[float | None, ...]] = {
    "DT": (0.4833, 0.2630, 0.2703, 0.2040, 0.2170),
    "GLRT": (0.4101, 0.3237, 0.4112, 0.0920, 0.1030),
    "BMM": (0.3121, 0.2894, 0.3903, 0.0322, 0.0443),
    "PTA": (0.3177, 0.2742, 0.4090, 0.0520, 0.0420),
    "DMDE": (0.297, None, 0.148, None, None),
    "Superpixel Soup": (0.1643, 0.0925, 0.1254, 0.0472, 0.0480),
    # compared in a figure, without printed numbers
    "ULDEMV": (None, None, None, None, None),
}
COMPARISON: Mapping[str, Mapping[str, float | None]] = {
    dataset: {method: errors[k] for method, errors in _PUBLISHED.items()}
    for k, dataset in enumerate(("sintel", "vkitti", "kitti", "kinect_paper", "kinect_tshirt"))
}
"""MRE by dataset and method; None where the paper prints none. KITTI is the odometry set 00-09
with LiDAR truth, not the stereo and flow sets of the suites."""

ABLATION: Mapping[str, tuple[float, float, float, float]] = {
    "alley_1": (0.2248, 0.2022, 0.1697, 0.1606),
    "ambush_4": (0.2381, 0.2093, 0.1701, 0.1676),
    "mountain_1": (0.2127, 0.1923, 0.1492, 0.1405),
    "sleeping_1": (0.2418, 0.2026, 0.1912, 0.1823),
}
"""MRE with E_arap, + E_proj, + E_cont, + E_orient (the paper's ablation table)."""

_KINECT = "Measured rows are of the pairs in the folder, whichever those are"
DATA: Mapping[str, str] = {
    "sintel": "The paper names the five sequences and 120 pairs, not which pairs",
    "vkitti": "The paper names the four worlds and 120 pairs, not which pairs",
    "kitti": "Published rows are of the odometry set 00-09 with LiDAR truth, measured ones of the"
    " stereo and flow training set with its own truth",
    "kinect_paper": _KINECT,
    "kinect_tshirt": _KINECT,
}
"""Pairs that the published and the measured numbers of a dataset are of, as far as known."""
