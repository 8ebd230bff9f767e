"""Finished work on disk."""

import numpy as np
import pytest

from lerobot_mimicik.data.retargeting.parts import PartStore, load_outcomes, save_outcomes
from lerobot_mimicik.data.retargeting.retarget import CHANGED, DROPPED, Outcome


def _outcome(seed: int, frames: int, gripper: bool = False) -> Outcome:
    rng = np.random.default_rng(seed)
    return Outcome(
        f"episode={seed}",
        "s",
        "pour",
        CHANGED,
        changes={"slowed down": 1.5},
        q=rng.normal(size=(frames, 6)),
        target=rng.normal(size=(frames, 7)),
        gripper=rng.uniform(size=frames) if gripper else None,
    )


@pytest.mark.parametrize(
    "outcomes",
    [
        [],
        [Outcome("a", "s", "", DROPPED, "too short")],
        [_outcome(0, 5), Outcome("a", "s", "", DROPPED, "collision"), _outcome(1, 3)],
        [_outcome(0, 5, True), _outcome(1, 2, True), Outcome("a", "s", "", DROPPED, "empty")],
        [_outcome(0, 4), _outcome(1, 2, True)],
    ],
)
def test_a_part_comes_back_as_it_was(tmp_path, outcomes):
    save_outcomes(tmp_path / "part.npz", outcomes)
    found = load_outcomes(tmp_path / "part.npz")
    assert len(found) == len(outcomes)
    for before, after in zip(outcomes, found, strict=True):
        for name, value in vars(before).items():
            if isinstance(value, np.ndarray) and value.size:
                np.testing.assert_array_equal(getattr(after, name), value)
            elif not isinstance(value, np.ndarray):
                assert getattr(after, name) == value
    assert [path.name for path in tmp_path.iterdir()] == ["part.npz"]


def test_a_store_knows_what_is_missing(tmp_path):
    store = PartStore(tmp_path / "parts", {"seed": 0}, resume=False)
    save_outcomes(store.path(1), [_outcome(0, 3)])
    assert PartStore(tmp_path / "parts", {"seed": 0}, resume=True).missing(3) == [0, 2]
    with pytest.raises(ValueError, match=r"other settings \(seed\)"):
        PartStore(tmp_path / "parts", {"seed": 1}, resume=True)
    assert PartStore(tmp_path / "parts", {"seed": 1}, resume=False).missing(3) == [0, 1, 2]
    store.remove()
    assert list(tmp_path.iterdir()) == []
