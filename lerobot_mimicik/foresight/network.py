"""The network's forward pass in numpy, from the tensors of a checkpoint.

A single query takes some 60 microseconds; torch would have to be imported and is slower on so little.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from lerobot_mimicik.foresight.features import PAST_STEPS

Array = NDArray[np.float64]

STEP_RAD = 0.1
"""Joint step that is 1 for the network: what an arm of 2 rad/s moves in a frame at 20 Hz."""
_SQRT_HALF = math.sqrt(0.5)


class FilterNetwork:
    """A filter whose coefficients a feed-forward network chooses for every query; see `modeling_foresight`."""

    def __init__(self, tensors: Mapping[str, Array], dof: int, objective: str, t_star: float) -> None:
        """
        Args:
            tensors: By the names of `modeling_foresight.FilterNetwork`.
            dof: Number of joints.
            objective: `regression` or `mip`.
            t_star: MIP's second time.

        Raises:
            ValueError: For another objective, which would draw noise.
            KeyError: If a tensor is missing.
        """
        if objective not in ("regression", "mip"):
            raise ValueError(f"objective={objective!r}: expected regression or mip, which draw no noise")
        self._refined = objective == "mip"
        self._dof, self._t_star = dof, t_star
        self._mean, self._scale = tensors["mean"].astype(float), tensors["scale"].astype(float)
        names = sorted(
            {name.rpartition(".")[0] for name in tensors if name.startswith("layers.")}, key=_number
        )
        self._layers = [
            (
                np.ascontiguousarray(tensors[f"{name}.weight"].T, dtype=float),
                tensors[f"{name}.bias"].astype(float),
            )
            for name in names
        ]
        self._lags = self._layers[-1][1].size // dof - 1

    def __call__(self, base: Array, observation: Array) -> Array:
        """The joint step (B, dof) [rad, m] of `Features`."""
        nothing = np.zeros_like(base)
        step = self._evaluate(base, observation, nothing, 0.0)
        if self._refined:
            step = self._evaluate(base, observation, step, self._t_star)
        return STEP_RAD * step

    def _evaluate(self, base: Array, observation: Array, answer: Array, time: float) -> Array:
        many, width = observation.shape
        x: Array = np.empty((many, width + self._dof + 2))
        x[:, :width] = (observation - self._mean) / self._scale
        x[:, width : width + self._dof] = answer
        x[:, -2:] = time
        for weight, bias in self._layers[:-1]:
            x = _gelu(x @ weight + bias)
        weight, bias = self._layers[-1]
        chosen = (x @ weight + bias).reshape(many, self._lags + 1, self._dof)
        seen = observation[:, : self._lags * self._dof].reshape(many, self._lags, self._dof)
        filtered = 0.5 * base + (chosen[:, :-1] * seen).sum(axis=1)
        return filtered / STEP_RAD + chosen[:, -1]


def lags(history: int) -> int:
    """Rows of an observation that the filter weighs: coefficients of the history, and past steps."""
    return history + PAST_STEPS


def _number(name: str) -> int:
    return int(name.split(".")[1])


def _gelu(x: Array) -> Array:
    return x * (0.5 + 0.5 * erf(_SQRT_HALF * x))
