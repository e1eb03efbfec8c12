"""The array types of the method."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["AnyImage", "Array", "Array32", "Image", "Indices", "Mask"]

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
#: Grey values, (h, w).
Image = NDArray[np.float32]
#: Pixels of any depth, (h, w) or (h, w, 3).
AnyImage = NDArray[np.generic]
