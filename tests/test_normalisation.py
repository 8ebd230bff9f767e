"""Min-max normalisation: its range, its inverse, its persistence and its errors."""

import pytest
import torch

from lerobot_mimicik.normalisation import MinMax


def test_training_range_becomes_minus_one_to_one_and_back():
    x = torch.randn(100, 3) * torch.tensor([1.0, 10.0, 0.01]) + 5
    normaliser = MinMax(3)
    normaliser.fit(x.amin(0), x.amax(0))
    y = normaliser.normalise(x)
    torch.testing.assert_close(y.amin(0), -torch.ones(3))
    torch.testing.assert_close(y.amax(0), torch.ones(3))
    torch.testing.assert_close(normaliser.unnormalise(y), x)


def test_dimension_that_never_moved_is_shifted_only():
    normaliser = MinMax(1)
    normaliser.fit(torch.tensor([2.0]), torch.tensor([2.0]))
    torch.testing.assert_close(normaliser.normalise(torch.tensor([2.5])), torch.tensor([0.5]))
    torch.testing.assert_close(normaliser.unnormalise(torch.tensor([0.5])), torch.tensor([2.5]))


def test_bounds_travel_in_the_state_dict():
    a, b = MinMax(2), MinMax(2)
    a.fit(torch.tensor([0.0, 1.0]), torch.tensor([4.0, 3.0]))
    b.load_state_dict(a.state_dict())
    torch.testing.assert_close(b.normalise(torch.tensor([4.0, 3.0])), torch.ones(2))


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        (torch.zeros(3), torch.ones(2), "shape"),
        (torch.tensor([float("nan"), 0.0]), torch.ones(2), "not finite"),
        (torch.tensor([2.0, 0.0]), torch.ones(2), "exceed"),
    ],
)
def test_impossible_bounds_are_refused(lower, upper, message):
    with pytest.raises(ValueError, match=message):
        MinMax(2).fit(lower, upper)
