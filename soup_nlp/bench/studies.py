"""The declared studies and departures: names of variants and the overrides that they stand for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from types import MappingProxyType
from typing import Any

from soup_nlp.bench.study import Overrides, Study, over
from soup_nlp.config.presets import PRESETS, leaves
from soup_nlp.config.problem import make_problem

NOISE_PX = ("0.1", "0.5", "1", "2")
"""Standard deviations of the noise on true flow, pixels."""


def without(*terms: str) -> Overrides:
    """Overrides that switch off terms of the energy."""
    return tuple(f"energy.weights.{t}=0.0" for t in terms)


STUDIES: Mapping[str, Study] = MappingProxyType(
    {
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
            "number of superpixels", over("segmentation.superpixels", (100, 250, 500, 1000, 2000))
        ),
        "neighbours": Study(
            "K of the K-NN graph",
            over("segmentation.neighbours", (4, 8, 12, 15, 20)),
        ),
        "pattern": Study(
            "SLIC against a regular grid", over("segmentation.method", ("slic", "grid"))
        ),
        "flow": Study(
            "flow: the truth, the truth with noise of 0.1 to 2 pixels, DIS",
            over("flow.source", ["truth", *(f"truth+noise:{px}" for px in NOISE_PX), "dis"]),
            true_flow=True,
        ),
        "stages": Study(
            "NLP and refinement, alone and together",
            {
                "NLP": ("refine.enabled=false",),
                "refinement": ("refine.from_start=true",),
                "both": (),
            },
        ),
        "confidence": Study("how well sigma of log depth sorts errors, and its calibration"),
    }
)
"""Studies by name; `confidence` has a page of its own."""


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
        with_off: Further options that "off alone" needs.
        with_on: Further options that "on alone" needs.
        needs: Explanation of the further options, for the table.
    """

    name: str
    keys: tuple[str, ...] = ()
    with_off: Mapping[str, Any] = field(default_factory=dict)
    with_on: Mapping[str, Any] = field(default_factory=dict)
    needs: str = ""

    def off_alone(self) -> Overrides:
        """Overrides of the defaults for "off alone"."""
        printed = dict(leaves(PRESETS["paper"]))
        return _overrides({**{k: printed[k] for k in self.keys}, **self.with_off})

    def on_alone(self) -> Overrides:
        """Overrides of the preset for "on alone"."""
        return _overrides({**{k: default(k) for k in self.keys}, **self.with_on})


def default(key: str) -> Any:
    """The default of an option."""
    return attrgetter(key)(make_problem({"input": {"kind": "motorcycle"}}))


def _overrides(values: Mapping[str, Any]) -> Overrides:
    return tuple(
        f"{key}={'.inf' if value == float('inf') else json.dumps(value)}"
        for key, value in values.items()
    )


_WEIGHTS = tuple(f"energy.weights.{w}" for w in ("arap", "proj", "cont", "orient", "sigma_cont"))
_ADDED = ("prior", "sigma_arap", "leak_arap")
_PIXELS = {key: default(key) for key in ("energy.units", "energy.rotation_px", *_WEIGHTS)}
_HELD = {f"energy.weights.{w}": default(f"energy.weights.{w}") for w in _ADDED}
_MORE = {"energy.pixel_samples": 64, "segmentation.boundary_samples": 12}
_SMALL = {"max_size": 0.05}
_SHARED = {"start.method": "shared"}

DEPARTURES = (
    Departure(
        "start: shared motions, scales by contact",
        ("start.method", "start.samples", "start.threshold_px", "start.ground"),
    ),
    Departure(
        "pixel units and their weights",
        ("energy.units", "energy.length", *_WEIGHTS),
        # a truncation given in pixels has no meaning in the paper's units
        with_off={"energy.weights.sigma_arap": float("inf")},
        needs="off: E_arap not truncated, since its truncation is in pixels",
    ),
    Departure(
        "E_arap truncated with a leak",
        ("energy.weights.sigma_arap", "energy.weights.leak_arap"),
        with_on={"energy.weights.sigma_arap": 1e-3},
        needs="on: at 0.001 in the paper's units",
    ),
    Departure(
        "E_arap and E_prior weak across components",
        ("energy.arap_across",),
        with_on=_SHARED,
        needs="on: with the start that finds components",
    ),
    Departure(
        "E_cont weak at occlusions",
        ("energy.cont_occluded",),
        with_on=_SHARED,
        needs="on: with the start that finds components",
    ),
    Departure(
        "another energy where surfaces bend",
        ("start.bending",),
        with_on={**_SHARED, **_PIXELS, **_HELD},
        needs="on: with the start that finds them, pixel units and all weights",
    ),
    Departure("prior on relief", ("energy.weights.prior",)),
    Departure(
        "depth prior", ("energy.weights.depth",), needs="a file: without one it has no elements"
    ),
    Departure(
        "order by occlusion",
        ("energy.weights.order",),
        with_on=_SHARED,
        needs="on: with the start that finds components",
    ),
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
        with_off=_MORE,
        with_on=_MORE,
        needs="off in both: 64 pixels a superpixel, 12 points a boundary (default 16 and 3)",
    ),
    Departure("gauge: d constant", ("formulation.gauge",)),
    Departure("visibility", ("formulation.min_facing", "formulation.depth_ratio")),
    Departure(
        "stages before the constrained NLP",
        with_off={"solver.presolve": False},
        with_on={"solver.presolve": False},
        needs="off in both; the preset has it, since it is a way to the minimum of the same energy",
    ),
    Departure(
        "proposals beyond walks, depths within reach",
        ("refine.proposals", "refine.depth_reach"),
    ),
    Departure("rounds end early", ("refine.rounds", "refine.stagnation")),
    Departure("images in the refinement", ("refine.photo", "refine.sweep")),
)
"""Every departure that options can undo; a test checks for missing ones."""
