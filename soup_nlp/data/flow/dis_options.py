"""Options of the flow by OpenCV's dense inverse search."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from soup_nlp.schema.section import Section

_HUGE = float(np.finfo(np.float32).max)  # OpenCV's parameters are float32


class DisOptions(Section):
    """Options of `dis_flow`; the constants of the method are in `data.flow.dis`."""

    equalize: bool = False
    """Equalise local contrast (CLAHE) first; for pairs with a change of exposure."""
    tau: Annotated[float, Field(ge=1e-6)] = 1.0
    """Forward-backward error, pixels, at which confidence is exp(-1)."""
    limit: Annotated[float, Field(ge=1e-6, le=_HUGE)] = 3.0
    """Forward-backward error, pixels, above which confidence is 0."""
