"""The step without Python between the network's operations.

A policy's `predict_joints` makes several hundred small torch calls. Alone that costs three times what the arithmetic
does; beside a driver's control thread each call may wait for the interpreter, and a step takes a frame's time.
Here the same computation is traced once and then runs as one call.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import torch

from lerobot_mimicik.inference.step import JointStep, example_inputs

if TYPE_CHECKING:
    from lerobot_mimicik.inference.engine import Array, Engine
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


def make(policy: LearnedIKPolicy) -> Engine:
    """The policy's step, traced and frozen where its weights are."""
    device, example = policy.delta.lower.device, example_inputs(policy)
    with torch.no_grad(), warnings.catch_warnings():
        # torch announces that tracing will give way to export; the Python floor of this project has it.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", torch.jit.TracerWarning)  # shapes are the same in every query
        step = torch.jit.freeze(
            torch.jit.trace(JointStep(policy, fold=True).eval(), example, check_trace=False)
        )

    def run(frames: Array, noise: Array) -> Array:
        with torch.inference_mode():
            return step(torch.from_numpy(frames).to(device), torch.from_numpy(noise).to(device)).cpu().numpy()

    return run
