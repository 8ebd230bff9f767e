"""Numbers that come from anywhere: lists, numpy, torch on any device and with gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def float_array(values: Any) -> NDArray[np.float64]:
    """A copy as float64, of the same shape.

    Raises:
        TypeError, ValueError: What holds no numbers.
    """
    if hasattr(values, "detach"):  # torch, which need not be imported for it; numpy knows no bfloat16
        values = values.detach().cpu().double().numpy()
    return np.array(values).astype(float, casting="same_kind")
