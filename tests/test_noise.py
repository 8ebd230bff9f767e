"""Numbers that belong to samples: their distribution, and independence of how a batch is split."""

import torch

from lerobot_mimicik.noise import sample_normal, sample_uniform


def test_same_sample_same_numbers_whatever_the_batch():
    index = torch.randperm(1000)
    whole = sample_normal(index, 6, seed=3, step=17)
    parts = torch.cat([sample_normal(part, 6, seed=3, step=torch.tensor(17)) for part in index.split(333)])
    assert torch.equal(whole, parts)


def test_seed_step_and_index_all_matter():
    index = torch.arange(50)
    reference = sample_normal(index, 6, seed=3, step=17)
    for other in (
        sample_normal(index, 6, seed=4, step=17),
        sample_normal(index, 6, seed=3, step=18),
        sample_normal(index + 50, 6, seed=3, step=17),
    ):
        assert (other == reference).float().mean() < 0.01


def test_uniform_fills_its_interval():
    x = sample_uniform(torch.arange(200_000), 3, seed=0, step=1)
    assert x.min() > 0
    assert x.max() < 1
    counts = torch.histc(x, 20, 0, 1) / x.numel()
    assert (counts - 0.05).abs().max() < 0.001


def test_normal_has_unit_covariance_and_normal_tails():
    x = sample_normal(torch.arange(200_000), 5, seed=0, step=1).double()
    assert x.mean(0).abs().max() < 0.01
    assert (torch.cov(x.T) - torch.eye(5)).abs().max() < 0.015
    assert abs((x.abs() > 2).double().mean() - 0.0455) < 0.001


def test_consecutive_steps_are_uncorrelated():
    index = torch.arange(100_000)
    a, b = (sample_normal(index, 1, seed=0, step=step)[:, 0].double() for step in (1, 2))
    assert torch.corrcoef(torch.stack([a, b]))[0, 1].abs() < 0.015
