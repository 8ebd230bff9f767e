"""Ranges of derived quantities (delta q, relative poses) over the training episodes."""

from collections.abc import Iterator

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_mimicik.batches.frames import FrameReader, IKFrames
from lerobot_mimicik.batches.loading import FrameTable
from lerobot_mimicik.configuration_learned import LearnedIKConfig
from lerobot_mimicik.kinematics.chain import SerialArm


class RunningRange:
    """Smallest and largest value of each dimension over chunks of rows."""

    def __init__(self, dim: int) -> None:
        self.lower = torch.full((dim,), torch.inf)
        self.upper = torch.full((dim,), -torch.inf)

    def update(self, values: Tensor) -> None:
        """Widens the range to hold `values`, shape (N, dim)."""
        if len(values):
            self.lower = torch.minimum(self.lower, values.amin(dim=0))
            self.upper = torch.maximum(self.upper, values.amax(dim=0))


def iterate_frames(
    table: FrameTable, config: LearnedIKConfig, arm: SerialArm, chunk: int = 16_384
) -> Iterator[IKFrames]:
    """All frames of a dataset, read as training reads them, in chunks.

    Args:
        table: Columns of the wanted episodes.
        config: Names the columns.
        arm: Forward kinematics on the CPU.
        chunk: Rows at a time.
    """
    reader = FrameReader(config)
    n_rows = len(table.first_row)
    for start in range(0, n_rows, chunk):
        rows = torch.arange(start, min(start + chunk, n_rows))
        batch: dict[str, Tensor] = {}
        for name in table.columns:
            offsets = config.action_delta_indices if name == ACTION else config.observation_delta_indices
            if name == ACTION or name.startswith("observation."):
                batch[name], batch[f"{name}_is_pad"] = table.window(name, rows, offsets)
        yield reader.training_frames(batch, arm)
