"""What computes a policy's step: the engines by name, fastest first. No torch is imported here.

A new engine is a module with `make(policy)`, which raises ModuleNotFoundError where its library is not installed, and
a line in `ENGINES`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.names import did_you_mean

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

Array = NDArray[np.floating]
Engine = Callable[[Array, Array], Array]
"""Frames, float64 (T_o, dof + 14), and noise, float32 (1, draws * dof), to a step [rad], float64 (dof,); see `step`."""

ENGINES = {
    "traced": "lerobot_mimicik.inference.traced",
    "eager": "lerobot_mimicik.inference.eager",
}
AUTO = "auto"
TOLERANCE = 1e-5  # rad by which an engine may differ from the policy: a hundredth of a millimetre at the tool
_QUERIES = 3  # that engines are compared by


def check_engine(name: str) -> str:
    """The name itself; ValueError for one that is no engine, with those that are."""
    if name not in (AUTO, *ENGINES):
        known = [AUTO, *ENGINES]
        raise ValueError(f"engine={name!r}: expected one of {', '.join(known)}." + did_you_mean(name, known))
    return name


def make_engine(policy: LearnedIKPolicy, name: str = AUTO) -> tuple[str, Engine]:
    """An engine for a policy with its present weights, and its name.

    Args:
        policy: On the device where it shall run.
        name: One of `ENGINES`, or `auto`: the fastest that is installed and agrees with the policy.

    Raises:
        ValueError: There is no such engine, or the one asked for disagrees by more than `TOLERANCE`.
        ModuleNotFoundError: The library of the one asked for is not installed.
    """
    check_engine(name)
    if name != AUTO:
        engine = importlib.import_module(ENGINES[name]).make(policy)
        apart = disagreement(policy, engine)
        if not apart <= TOLERANCE:
            raise ValueError(
                f"engine={name!r} disagrees with the policy by {apart:.2e} rad, more than {TOLERANCE:g}: "
                f"make it again from this checkpoint, or take engine={AUTO!r}."
            )
        return name, engine
    for each, module in ENGINES.items():
        try:
            engine = importlib.import_module(module).make(policy)
        except ModuleNotFoundError:
            continue
        if disagreement(policy, engine) <= TOLERANCE:
            return each, engine
    raise ValueError(f"none of the engines {', '.join(ENGINES)} agrees with the policy.")


def disagreement(policy: LearnedIKPolicy, engine: Engine) -> float:
    """The largest difference [rad] between an engine's steps and the policy's, over a few queries near its home."""
    from lerobot_mimicik.inference import eager
    from lerobot_mimicik.kinematics.point_chain import point_chain

    reference, config, random = eager.make(policy), policy.config, np.random.default_rng(0)
    chain = point_chain(config.arm_description())
    lower, upper = (bound.double().cpu().numpy() for bound in (policy.arm.lower, policy.arm.upper))
    worst = 0.0
    for _ in range(_QUERIES):
        q = random.uniform(lower, upper, config.dof) + random.normal(
            0.0, 0.01, (config.n_obs_steps, config.dof)
        )
        targets = np.array([chain.pose(each + 0.01) for each in q])
        frames = np.concatenate([q, np.array([chain.pose(each) for each in q]), targets], axis=-1)
        noise = random.normal(size=(1, policy.objective.draws * config.dof)).astype(np.float32)
        worst = max(worst, float(np.abs(engine(frames, noise) - reference(frames, noise)).max()))
    return worst
