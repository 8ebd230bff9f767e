"""A sampler that computes whole epochs yields what LeRobot's yields, also when it changes in mid-epoch."""

import itertools

import pytest
from lerobot.datasets.sampler import EpisodeAwareSampler

from lerobot_mimicik.batches.sampling import EpochSampler, vectorise_samplers

_ROWS = {row: 3 * row + 1 for row in range(40)}


def make(**options):
    return EpisodeAwareSampler([0, 7, 19, 20], [7, 19, 20, 40], seed=3, **options)


@pytest.mark.parametrize(
    "options",
    [
        {"shuffle": True},
        {"shuffle": False},
        {"shuffle": True, "drop_n_last_frames": 1},
        {"shuffle": True, "episode_indices_to_use": [1, 3], "absolute_to_relative_idx": _ROWS},
    ],
)
def test_same_order_over_epochs_and_after_resuming(options):
    stock, mine = make(**options), make(**options)
    mine.__class__ = EpochSampler
    for _ in range(2):
        assert list(mine) == list(stock)
    for sampler in (stock, mine):
        sampler.load_state_dict({"epoch": 5, "start_index": 6})
    assert list(mine) == list(stock)
    assert mine.state_dict() == stock.state_dict()
    assert mine.indices == stock.indices


def test_live_samplers_change_in_mid_epoch():
    stock = list(make(shuffle=True))
    live = make(shuffle=True)
    running = iter(live)
    head = list(itertools.islice(running, 10))
    vectorise_samplers()
    assert type(live) is EpochSampler
    assert head + list(running) == stock
