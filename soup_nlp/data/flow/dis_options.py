"""Options of OpenCV's DIS flow and of its forward-backward check, with their ranges."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from soup_nlp.data.flow.consistency import SUPPORT
from soup_nlp.schema.section import Section

_HUGE = float(np.finfo(np.float32).max)  # OpenCV's parameters are int and float32
_Float32 = Annotated[float, Field(ge=0, le=_HUGE)]


class DisOptions(Section):
    """Options of `dis_flow`.

    The defaults are the medium preset at full resolution with denser patches (stride 2 for 3)
    and a longer, smoother refinement (20 iterations for 5, alpha 30 for 20) that weighs
    gradients above intensities (delta 1 for 5); the error falls on driving, indoor and rendered
    pairs.
    """

    finest_scale: Annotated[int, Field(ge=0, le=5)] = 0
    """Finest pyramid level; 0 is full resolution, each level halves it."""
    preset: Literal["ultrafast", "fast", "medium"] = "medium"
    """Values of the settings that are not given here."""
    patch_size: Annotated[int, Field(ge=4, le=32)] = 8
    """Side of a patch, pixels."""
    patch_stride: Annotated[int, Field(ge=1, le=32)] = 2
    """Distance of patches, pixels, at most patch_size; smaller is denser and slower."""
    refinement_iterations: Annotated[int, Field(ge=0, le=10_000)] = 20
    """Fixed-point iterations of the variational refinement; 0 is none."""
    alpha: _Float32 = 30.0
    """Weight of smoothness in the refinement."""
    delta: _Float32 = 1.0
    """Weight of constant intensity."""
    gamma: _Float32 = 10.0
    """Weight of constant gradient."""
    equalize: bool = False
    """Equalise local contrast (CLAHE) first; for pairs with a change of exposure."""
    tau: Annotated[float, Field(ge=1e-6)] = 1.0
    """Forward-backward error, pixels, at which confidence is exp(-1)."""
    limit: Annotated[float, Field(ge=1e-6, le=_HUGE)] = 3.0
    """Forward-backward error, pixels, above which confidence is 0."""
    support: Annotated[int, Field(ge=1, le=10_001)] = SUPPORT
    """Side of the window for the mean error, odd, pixels; 1 is the pixel itself."""
    planes: Annotated[int, Field(ge=0, le=20)] = 4
    """Dominant homographies under which the flow is computed again; 0 for none."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.patch_stride > self.patch_size:
            raise ValueError("patch_stride at most patch_size")
        if self.support % 2 == 0:
            raise ValueError("support an odd number of pixels")
        return self
