"""LeRobot's pre- and post-processing for the UNet baseline: as for MimicIK, its default steps without normalisation."""

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_mimicik.baselines.configuration_unet import UNetConfig


def make_mimicik_unet_pre_post_processors(
    config: UNetConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Pre-processor (rename, batch, device) and post-processor (to the CPU) of a policy."""
    return make_default_pre_post_processors(config, dataset_stats)
