"""LeRobot's pre- and post-processing for MimicIK: its default steps, with identity normalisation.

The policy works in SI units on derived quantities (poses, joint differences) and normalises these by
itself, with statistics saved among its weights; the default steps stay because LeRobot overrides them by
name when it resumes or fine-tunes.
"""

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_mimicik.configuration_mimicik import MimicIKConfig


def make_mimicik_pre_post_processors(
    config: MimicIKConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Pre-processor (rename, batch, device) and post-processor (to the CPU) of a MimicIK policy."""
    return make_default_pre_post_processors(config, dataset_stats)
