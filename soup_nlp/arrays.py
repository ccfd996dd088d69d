"""Types of arrays that many rooms use."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
FloatMap = NDArray[np.float32]
AnyFloat = NDArray[np.floating]
"""Of any precision."""
Int = NDArray[np.int64]
Labels = NDArray[np.int32]
"""(H, W) superpixel of every pixel."""
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]
"""(H, W, 3) RGB, or (H, W) grey."""
