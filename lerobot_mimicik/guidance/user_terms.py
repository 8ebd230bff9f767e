"""Costs of the user's own, beside the compiled ones: linearised where the plan is, then descended with the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Quadratic = tuple[Array, Array, Array]
"""M (N, N), s (N,) and r (N,) of the cost -2 s'(x - r) + (x - r)'M (x - r), x flattened."""

_ROUNDS = 3  # linearisations, at most


class CostTerm(Protocol):
    """A sum of squares that is added to the cost of a plan.

    Costs are relative to a squared pose error in m^2: a residual of 0.001 weighs like a millimetre.
    """

    def __call__(self, joints: Array) -> tuple[Array, Array]:
        """Residuals (m,) and their Jacobian (m, T, dof) of planned joints (T, dof)."""


def descend_with_terms(
    x: Array, terms: Sequence[CostTerm], descend: Callable[[Quadratic], tuple[float, Array]]
) -> tuple[float, Array]:
    """Improve the plan `x` (T, dof) in place by `descend`, which takes the terms as a quadratic.

    Returns:
        The cost with the terms and the pose residuals (T, 6). The plan never gets worse by that cost.

    Raises:
        ValueError: A term answers with other shapes, or with numbers that are not finite.
    """
    best: tuple[float, Array, Array] | None = None
    for _ in range(_ROUNDS):
        reference = x.copy()
        residual, jacobian = _evaluate(terms, x)
        quadratic: Quadratic = (jacobian.T @ jacobian, -jacobian.T @ residual, reference.ravel())
        cost, pose = descend(quadratic)
        moved = (x - reference).ravel()
        modelled = float(moved @ quadratic[0] @ moved - 2.0 * quadratic[1] @ moved)
        total = cost - modelled + float(np.square(_evaluate(terms, x)[0]).sum())
        if best is not None and total >= best[0]:
            break
        best = (total, x.copy(), pose)
        if np.abs(moved).max() < 1e-6:
            break
    assert best is not None
    x[:] = best[1]
    return best[0], best[2]


def _evaluate(terms: Sequence[CostTerm], x: Array) -> tuple[Array, Array]:
    residuals, jacobians = [], []
    for term in terms:
        residual, jacobian = term(x.copy())
        residual, jacobian = np.asarray(residual, dtype=float), np.asarray(jacobian, dtype=float)
        if residual.ndim != 1 or jacobian.shape != (len(residual), *x.shape):
            raise ValueError(
                f"the cost term {term!r} answered with shapes {residual.shape} and {jacobian.shape}; expected (m,) "
                f"and (m, {x.shape[0]}, {x.shape[1]})"
            )
        if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
            raise ValueError(f"the cost term {term!r} answered with numbers that are not finite")
        residuals.append(residual)
        jacobians.append(jacobian.reshape(len(residual), -1))
    return np.concatenate(residuals), np.concatenate(jacobians)
