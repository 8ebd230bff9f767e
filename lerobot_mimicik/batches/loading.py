"""Whole-batch reading of low-dimensional LeRobot datasets.

LeRobot reads a training sample frame by frame and column by column; on joint data that costs far more
than the training step. torch's loader asks a dataset for a whole batch at once where the dataset offers
`__getitems__`, so the datasets of a MimicIK run are given one that answers from columns in memory:
the same numbers, already collated; no camera is decoded and no task sentence repeated. Only these objects
change; LeRobot and the datasets of other policies stay as they are.
"""

import gc
from typing import Any

import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

from lerobot_mimicik.batches.sampling import vectorise_samplers


class FrameTable:
    """The numeric columns of a dataset in memory, with the window queries of LeRobot.

    Attributes:
        columns: Name -> tensor of shape (N, d), or (N,) for scalars; the rows of the loaded episodes.
        first_row, last_row: Bounds of each row's episode, int64, shape (N,).
    """

    def __init__(self, dataset: LeRobotDataset):
        table = dataset.hf_dataset.with_format("numpy", columns=_numeric_columns(dataset))
        self.columns: dict[str, Tensor] = {
            name: torch.from_numpy(values.copy()) for name, values in table[:].items()
        }
        episodes = self.columns["episode_index"]
        starts = torch.ones_like(episodes, dtype=torch.bool)
        starts[1:] = episodes[1:] != episodes[:-1]
        bounds = torch.cat([starts.nonzero().squeeze(1), torch.tensor([len(episodes)])])
        run = starts.cumsum(0) - 1
        self.first_row, self.last_row = bounds[run], bounds[run + 1] - 1

    def window(self, name: str, rows: Tensor, offsets: list[int]) -> tuple[Tensor, Tensor]:
        """A column around each row, repeated at the ends of the episode.

        Args:
            name: The column.
            rows: Shape (B,).
            offsets: Frames relative to the row, W of them.

        Returns:
            Values, shape (B, W, d), and which of them lie outside the episode, bool, shape (B, W).
        """
        wanted = rows[:, None] + torch.tensor(offsets)
        first, last = self.first_row[rows, None], self.last_row[rows, None]
        padded = (wanted < first) | (wanted > last)
        return self.columns[name][wanted.clamp(first, last)], padded


def _numeric_columns(dataset: LeRobotDataset) -> list[str]:
    return [
        name
        for name, feature in dataset.meta.features.items()
        if feature["dtype"] not in ("video", "image", "string", "language")
        and name in dataset.hf_dataset.features
    ]


class CollatedBatch:
    """A batch that needs no collation: torch's default collate function passes its contents on."""

    def __init__(self, contents: dict[str, Any]):
        self.contents = contents


def _contents(batch: list[CollatedBatch], *, collate_fn_map: Any = None) -> dict[str, Any]:
    return batch[0].contents


# torch's registry for types of one's own; nothing else has this type.
default_collate_fn_map[CollatedBatch] = _contents


class BatchedLeRobotDataset(LeRobotDataset):
    """A LeRobotDataset that reads batches at once. Existing objects become one through `read_batched`."""

    _frame_table: FrameTable | None = None
    _asked = False

    @property
    def frame_table(self) -> FrameTable:
        """The columns in memory, loaded at first use."""
        if self._frame_table is None:
            self._frame_table = FrameTable(self)
        return self._frame_table

    def __getstate__(self) -> dict[str, Any]:
        # A loader's worker reads the (memory-mapped) columns itself rather than receiving a copy.
        return {**self.__dict__, "_frame_table": None, "_asked": False}

    def __getitems__(self, indices: list[int]) -> list[CollatedBatch]:
        """The numbers that collating `[self[i] for i in indices]` gives: no camera frames, no tasks.

        A list of one, as torch's loader hands a list to its collate function.
        """
        if not self._asked:  # only now is there a sampler, made after the policy
            vectorise_samplers()
            self._asked = True
        table = self.frame_table
        rows = torch.tensor(indices)
        offsets = self._ensure_reader().delta_indices or {}
        batch: dict[str, Any] = {}
        for name, values in table.columns.items():
            if name in offsets:
                batch[name], batch[f"{name}_is_pad"] = table.window(name, rows, offsets[name])
            else:
                batch[name] = values[rows]
        return [CollatedBatch(batch)]


def read_batched(meta: LeRobotDatasetMetadata) -> BatchedLeRobotDataset | None:
    """Makes the training run's datasets read whole batches.

    LeRobot hands a policy the dataset's metadata but not the dataset, so the live datasets on the same
    files are looked up: the training split shares this very metadata object, the evaluation split has a
    copy. Only their class changes, to a subclass that adds `__getitems__`.

    Returns:
        The dataset that owns `meta`, or None where there is none that can be read so (a streaming
        dataset, or one with language columns).
    """
    training = None
    for candidate in gc.get_objects():
        if type(candidate) not in (LeRobotDataset, BatchedLeRobotDataset) or candidate.root != meta.root:
            continue
        if candidate.meta.has_language_columns:
            continue  # LeRobot collates these by a function of its own, sample by sample
        candidate.__class__ = BatchedLeRobotDataset
        if candidate.meta is meta:
            training = candidate
    return training
