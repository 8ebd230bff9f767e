"""LeRobot's pre- and post-processing for foresight: as for MimicIK, its default steps without normalisation."""

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_mimicik.configuration_foresight import ForesightConfig


def make_mimicik_foresight_pre_post_processors(
    config: ForesightConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Pre-processor (rename, batch, device) and post-processor (to the CPU) of a policy."""
    return make_default_pre_post_processors(config, dataset_stats)
