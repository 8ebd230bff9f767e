"""The box of joints within reach of one control step, and the least-squares step that stays in a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def step_box(q: Array, lower: Array, upper: Array, max_step: float) -> tuple[Array, Array]:
    """Lowest and highest joints to command next.

    Within the limits and `max_step` of `q`. A joint measured outside its limits is led back by at most
    `max_step`: the bound on the step is the stronger one.
    """
    return np.clip(lower, q - max_step, q + max_step), np.clip(upper, q - max_step, q + max_step)


def bounded_step(jacobian: Array, goal: Array, damping: float, lowest: Array, highest: Array) -> Array:
    """The step d (n,) that minimises |J d - goal|^2 + damping |d|^2 with lowest <= d <= highest.

    A primal active set: go towards the solution of the free joints up to the first bound, fix what met
    it, and once none is in the way free the joint that gains most by leaving its bound.

    Args:
        jacobian, goal: J (m, n) and the step's aim (m,).
        damping: Positive unless J has full column rank.
        lowest, highest: Bounds (n,) with zero between them; may be infinite.
    """
    n = jacobian.shape[1]
    step, free = np.zeros(n), np.ones(n, dtype=bool)
    gram, pull = jacobian.T @ jacobian + damping * np.eye(n), jacobian.T @ goal
    for _ in range(4 * n):
        wanted = step.copy()
        wanted[free] = np.linalg.solve(
            gram[np.ix_(free, free)], pull[free] - gram[np.ix_(free, ~free)] @ step[~free]
        )
        outside = free & ((wanted < lowest) | (wanted > highest))
        if outside.any():
            room = np.where(wanted > step, highest, lowest)[outside] - step[outside]
            share = room / (wanted - step)[outside]
            step = np.clip(step + share.min() * (wanted - step), lowest, highest)
            free[np.flatnonzero(outside)[share <= share.min()]] = False
            continue
        step = wanted
        gain = pull - gram @ step
        gain = np.where(step <= lowest, np.maximum(gain, 0.0), np.maximum(-gain, 0.0))
        gain[free | (lowest >= highest)] = 0.0
        if gain.max() <= 1e-12:
            break
        free[gain.argmax()] = True
    return step
