"""Whole-batch reading gives the samples LeRobot gives, and changes no dataset but the run's own."""

import pickle

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from teleop import write_teleop
from torch.utils.data import default_collate

from lerobot_mimicik.batches.loading import BatchedLeRobotDataset, read_batched


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_teleop(tmp_path_factory.mktemp("data") / "teleop", episodes=5, frames=12)


def open_dataset(root, episodes=None, windows=True):
    offsets = {key: [-0.05, 0.0, 0.05] for key in ("observation.state", "observation.ee_target", "action")}
    return LeRobotDataset(
        "local/teleop", root=root, episodes=episodes, delta_timestamps=offsets if windows else None
    )


@pytest.mark.parametrize("episodes", [None, [1, 3, 4]])
@pytest.mark.parametrize("windows", [True, False])
def test_same_samples_as_lerobot(root, episodes, windows):
    stock, batched = open_dataset(root, episodes, windows), open_dataset(root, episodes, windows)
    assert read_batched(batched.meta) is batched
    indices = [0, 11, 12, 5, len(stock) - 1, 0]
    expected = default_collate([stock[index] for index in indices])
    batch = default_collate(batched.__getitems__(indices))
    assert batch.keys() == expected.keys() - {"task"}  # the sentence; its number is there
    for key, value in batch.items():
        assert value.dtype == expected[key].dtype, key
        assert torch.equal(value, expected[key]), key


def test_through_torch_loader_with_workers(root):
    stock, batched = open_dataset(root), open_dataset(root)
    read_batched(batched.meta)
    loaders = [
        torch.utils.data.DataLoader(dataset, 7, num_workers=workers, multiprocessing_context=context)
        for dataset, workers, context in ((stock, 0, None), (batched, 1, "spawn"))
    ]
    for a, b in zip(*loaders, strict=True):
        assert torch.equal(a["observation.state"], b["observation.state"])
        assert torch.equal(a["action_is_pad"], b["action_is_pad"])


def test_only_datasets_on_the_same_files_change(root, tmp_path):
    other = LeRobotDataset("local/other", root=write_teleop(tmp_path / "other", episodes=1, frames=5))
    mine, evaluation = open_dataset(root, [0, 1]), open_dataset(root, [2])
    assert read_batched(mine.meta) is mine
    assert type(other) is LeRobotDataset
    assert type(evaluation) is BatchedLeRobotDataset
    assert "__getitems__" not in vars(LeRobotDataset)


def test_pickled_dataset_leaves_its_table_behind(root):
    dataset = open_dataset(root)
    read_batched(dataset.meta)
    assert len(dataset.frame_table.first_row) == 60
    copy = pickle.loads(pickle.dumps(dataset))
    assert copy._frame_table is None
    assert torch.equal(default_collate(copy.__getitems__([3]))["action"][0], dataset[3]["action"])
