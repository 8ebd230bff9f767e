"""What an engine is, and by how much one may differ from its policy. No torch is imported here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.inference.facts import StepFacts
from lerobot_mimicik.kinematics.point_chain import point_chain

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

Array = NDArray[np.floating]
Engine = Callable[[Array, Array], Array]
"""Frames, float64 (T_o, dof + 14), and noise, float32 (1, draws * dof), to a step [rad], float64 (dof,); see `step`."""

TOLERANCE = 1e-5  # rad by which an engine may differ from the policy: a hundredth of a millimetre at the tool
_QUERIES = 3  # that engines are compared by


class EngineUnavailable(RuntimeError):  # noqa: N818 - a state of the machine more than a mistake
    """An engine that is known but cannot run here; the message gives the reason and the remedy."""


def disagreement(policy: LearnedIKPolicy, engine: Engine) -> float:
    """The largest difference [rad] between an engine's steps and the policy's, over a few queries near its home."""
    from lerobot_mimicik.inference import eager

    reference = eager.make(policy)
    return max(
        float(np.abs(engine(frames, noise) - reference(frames, noise)).max())
        for frames, noise in example_queries(StepFacts.of(policy))
    )


def example_queries(facts: StepFacts) -> Iterator[tuple[Array, Array]]:
    """Frames and noise of a few queries that differ from each other, always the same."""
    random, chain, dof = np.random.default_rng(0), point_chain(facts.description), len(facts.lower)
    lower, upper = np.clip(facts.lower, -np.pi, None), np.clip(facts.upper, None, np.pi)
    for _ in range(_QUERIES):
        q = random.uniform(lower, upper, dof) + random.normal(0.0, 0.01, (facts.steps, dof))
        targets = np.array([chain.pose(each + 0.01) for each in q])
        frames = np.concatenate([q, np.array([chain.pose(each) for each in q]), targets], axis=-1)
        yield frames, random.normal(size=(1, facts.width)).astype(np.float32)
