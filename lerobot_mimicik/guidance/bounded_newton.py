"""The compiled step of a least-squares problem with bounds: a banded Cholesky factorisation and an active set."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_jit = njit(cache=True, error_model="numpy")


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def cholesky_solve(h, g, band, d):
    """Solve the banded symmetric positive definite h d = g, h in place; False where it is not positive.

    Row by row, so that the sums run along memory (Cholesky-Banachiewicz).
    """
    n = len(g)
    for i in range(n):
        first = max(0, i - band)
        for j in range(first, i):
            value = h[i, j]
            for k in range(max(first, j - band), j):
                value -= h[i, k] * h[j, k]
            h[i, j] = value / h[j, j]
        pivot = h[i, i]
        for k in range(first, i):
            pivot -= h[i, k] * h[i, k]
        if not pivot > 0.0:
            return False
        h[i, i] = math.sqrt(pivot)
        value = g[i]
        for k in range(first, i):
            value -= h[i, k] * d[k]
        d[i] = value / h[i, i]
    for i in range(n - 1, -1, -1):
        d[i] /= h[i, i]
        for k in range(max(0, i - band), i):
            d[k] -= h[i, k] * d[i]
    return True


@_jit
def bounded_newton(h, g, x, lower, upper, band, d, work, passes):
    """The step d (N,) of the model 1/2 d'h d - g'd with lower <= x + d <= upper, by an active set.

    Variables at a bound that the gradient presses against are fixed; those that the solution of the others would
    carry over a bound are put onto it and fixed too, `passes` times at most.
    """
    n = len(g)
    fixed = np.zeros(n, dtype=np.bool_)
    rhs = np.empty(n)
    for i in range(n):
        d[i] = 0.0
        if (x[i] <= lower[i] and g[i] < 0.0) or (x[i] >= upper[i] and g[i] > 0.0):
            fixed[i] = True
    target = np.empty(n)
    for _ in range(passes):
        for i in range(n):
            for k in range(max(0, i - band), i + 1):
                work[i, k] = h[i, k]
            rhs[i] = g[i]
        for i in range(n):
            if not fixed[i]:
                continue
            for k in range(max(0, i - band), min(n, i + band + 1)):
                if not fixed[k]:
                    rhs[k] -= (h[i, k] if i >= k else h[k, i]) * d[i]
        for i in range(n):
            if fixed[i]:
                for k in range(max(0, i - band), i):
                    work[i, k] = 0.0
                for k in range(i + 1, min(n, i + band + 1)):
                    work[k, i] = 0.0
                work[i, i] = 1.0
                rhs[i] = d[i]
        if not cholesky_solve(work, rhs, band, target):
            return False
        outside = False
        for i in range(n):
            if fixed[i]:
                continue
            d[i] = target[i]
            if x[i] + d[i] < lower[i] - 1e-12:
                d[i] = lower[i] - x[i]
                fixed[i] = outside = True
            elif x[i] + d[i] > upper[i] + 1e-12:
                d[i] = upper[i] - x[i]
                fixed[i] = outside = True
        if not outside:
            return True
    return True
