"""Tasks keep an operator at work for as long as asked, in the neighbourhood of their places."""

import numpy as np
import pytest

from lerobot_mimicik.data.teleoperation.hand_motion import HandPath, sample_style
from lerobot_mimicik.data.teleoperation.operator_tasks import TASKS, draw_task, perform

PLACES = np.random.default_rng(0).uniform(
    [0.2, -0.2, 0.1, -0.3, -0.3, -0.3], [0.5, 0.2, 0.3, 0.3, 0.3, 0.3], (20, 6)
)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_task_lasts_as_long_as_asked_and_stays_about_its_places(task, seed):
    rng = np.random.default_rng(seed)
    path = HandPath(PLACES[0], sample_style(rng), rng)
    perform(task, path, PLACES, 12.0)
    assert 12.0 <= path.now < 12.0 + 10.0
    motion = path.sample(np.arange(0.0, path.now, 0.05))
    assert np.all(motion[:, :3] > PLACES[:, :3].min(axis=0) - 0.2)
    assert np.all(motion[:, :3] < PLACES[:, :3].max(axis=0) + 0.2)
    speed = np.linalg.norm(np.diff(motion[:, :3], axis=0), axis=1) / 0.05
    assert 0.01 < speed.mean() < 0.4
    assert speed[-3:].max() < 1e-9


def test_all_tasks_occur():
    rng = np.random.default_rng(0)
    assert {draw_task(rng) for _ in range(200)} == set(TASKS)
