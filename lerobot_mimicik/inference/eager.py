"""The step as torch runs it operation by operation: always there, and what the other engines are held against."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from lerobot_mimicik.inference.step import JointStep

if TYPE_CHECKING:
    from lerobot_mimicik.inference.engine import Array, Engine
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


def make(policy: LearnedIKPolicy) -> Engine:
    """The policy's step, where its weights are."""
    step, device = JointStep(policy).eval(), policy.delta.lower.device

    def run(frames: Array, noise: Array) -> Array:
        with torch.inference_mode():
            return step(torch.from_numpy(frames).to(device), torch.from_numpy(noise).to(device)).cpu().numpy()

    return run
