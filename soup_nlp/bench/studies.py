"""The declared studies: names of variants and the overrides that they stand for."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from soup_nlp.bench.study import Overrides, Study, over

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
            "number of superpixels",
            over("segmentation.superpixels", (100, 250, 500, 1000, 2000)),
            key="segmentation.superpixels",
        ),
        "neighbours": Study(
            "K of the K-NN graph",
            over("segmentation.neighbours", (4, 8, 12, 15, 20)),
            key="segmentation.neighbours",
        ),
        "pattern": Study(
            "SLIC against a regular grid", over("segmentation.method", ("slic", "grid"))
        ),
        "flow": Study(
            "flow: the truth, the truth with noise of 0.1 to 2 pixels, DIS",
            over("flow.source", ["truth", *(f"truth+noise:{px}" for px in NOISE_PX), "dis"]),
            key="flow.source",
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
"""Studies by name; `confidence` has a measurement and a page of its own."""
