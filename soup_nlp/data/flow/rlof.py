"""Robust local optical flow, dense (Geistert et al., 2016; Senst et al.), of opencv-contrib."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.flow.consistency import checked_flow
from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError

Image = NDArray[np.uint8]

MIN_SIDE = 32
"""Smallest image side, pixels."""


def rlof_flow(image_ref: Image, image_next: Image) -> Flow:
    """Dense RLOF with forward-backward confidence.

    A robust sparse flow on a grid is checked forward and backward, interpolated along edges (EPIC)
    and refined by a variational method. Both images are (H, W, 3) uint8 RGB.

    Raises:
        DataError: OpenCV has no contributed modules, or the images are too small or differ in size.
    """
    if not hasattr(cv2, "optflow"):
        raise DataError(
            "this OpenCV has no DenseRLOF",
            where="flow source 'rlof'",
            found=f"OpenCV {cv2.__version__} without contributed modules",
            expected="opencv-contrib-python-headless",
            hint="pip uninstall opencv-python-headless; pip install opencv-contrib-python-headless",
        )
    small = min(image_ref.shape[:2]) < MIN_SIDE
    if image_ref.shape != image_next.shape or image_ref.shape[2:] != (3,) or small:
        raise DataError(
            "images do not suit RLOF",
            found=f"{image_ref.shape} and {image_next.shape}",
            expected=f"two RGB images of one size, at least {MIN_SIDE} pixels on each side",
        )
    method: Any = cv2.optflow.DenseRLOFOpticalFlow.create()
    method.setGridStep((4, 4))
    method.setInterpolation(cv2.optflow.INTERP_EPIC)
    method.setForwardBackward(1.0)
    method.setUsePostProc(True)
    method.setUseVariationalRefinement(True)
    a, b = (cv2.cvtColor(image, cv2.COLOR_RGB2BGR) for image in (image_ref, image_next))
    try:
        forward, backward = method.calc(a, b, None), method.calc(b, a, None)
    except cv2.error as error:
        raise DataError("RLOF failed", found=str(error).strip()) from error
    return checked_flow(forward, backward, "rlof")
