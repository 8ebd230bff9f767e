"""What a teleoperator does in an episode: everyday tasks as goals for the hand.

Each task is a generator of `Goal`s over a pool of places that the arm reaches; poses are (6,) as in
`hand_motion`.
"""

from collections.abc import Callable, Iterator

import numpy as np

from lerobot_mimicik.data.arm_arrays import Array
from lerobot_mimicik.data.teleoperation.hand_motion import Goal, HandPath

_LONGEST_S = 40.0  # an episode ends here whatever the task


def pick_and_place(places: Array, rng: np.random.Generator) -> Iterator[Goal]:
    """Approach from above, grasp, lift, carry, put down, withdraw; again with the next object."""
    while True:
        grasp, put = _two(places, rng)
        for pose in (grasp, put):
            above = _shifted(pose, z=rng.uniform(0.03, 0.09))
            yield Goal(above)
            yield Goal(pose, pace=0.6, rest_s=rng.uniform(0.05, 0.35))
            yield Goal(_shifted(pose, z=rng.uniform(0.03, 0.09)), pace=0.8)


def wipe(places: Array, rng: np.random.Generator) -> Iterator[Goal]:
    """Strokes to and fro on a surface, each beside the last."""
    while True:
        corner = places[rng.integers(len(places))]
        yield Goal(corner, rest_s=0.1)
        heading = rng.uniform(0, 2 * np.pi)
        stroke = rng.uniform(0.04, 0.10) * np.array([np.cos(heading), np.sin(heading)])
        beside = rng.uniform(0.008, 0.02) * np.array([-np.sin(heading), np.cos(heading)])
        for i in range(int(rng.integers(4, 9))):
            x, y = (0.5 if i % 2 else -0.5) * stroke + (i - 3) * beside
            yield Goal(_shifted(corner, x, y), pace=1.1)


def inspect(places: Array, rng: np.random.Generator) -> Iterator[Goal]:
    """Turns about a place to see or reach it from several sides."""
    while True:
        centre = places[rng.integers(len(places))]
        yield Goal(centre)
        for _ in range(int(rng.integers(3, 7))):
            pose = centre.copy()
            pose[:3] += rng.normal(size=3) * 0.012
            pose[3:] += rng.normal(size=3) * 0.22
            yield Goal(pose, pace=0.9)


def insert(places: Array, rng: np.random.Generator) -> Iterator[Goal]:
    """Carries a part to a hole and fits it with small careful movements."""
    while True:
        part, hole = _two(places, rng)
        yield Goal(part, rest_s=0.2)
        yield Goal(_shifted(hole, z=0.05))
        for _ in range(int(rng.integers(3, 8))):
            pose = _shifted(hole, z=rng.uniform(0.0, 0.02))
            pose += rng.normal(size=6) * np.repeat([0.004, 0.03], 3)
            yield Goal(pose, pace=0.7)
        yield Goal(hole, pace=0.5, rest_s=0.2)
        yield Goal(_shifted(hole, z=0.06), pace=0.8)


def reach(places: Array, rng: np.random.Generator) -> Iterator[Goal]:
    """Goes from place to place."""
    while True:
        yield Goal(places[rng.integers(len(places))])


Task = Callable[[Array, np.random.Generator], Iterator[Goal]]

# The sentence stored with each episode, and how often the task occurs.
TASKS: dict[str, tuple[Task, float]] = {
    "Pick up the object and place it": (pick_and_place, 0.35),
    "Wipe the surface": (wipe, 0.15),
    "Turn the tool around the object": (inspect, 0.15),
    "Insert the part": (insert, 0.15),
    "Reach from place to place": (reach, 0.20),
}


def draw_task(rng: np.random.Generator) -> str:
    """One of TASKS, by its frequency."""
    weights = np.array([weight for _, weight in TASKS.values()])
    return list(TASKS)[rng.choice(len(TASKS), p=weights / weights.sum())]


def perform(task: str, path: HandPath, places: Array, seconds: float) -> None:
    """Lets the operator of `path` work at `task` for about `seconds`, to the end of a whole movement."""
    goals = TASKS[task][0](places, path.rng)
    while path.now < min(seconds, _LONGEST_S):
        path.move(next(goals))
    path.settle(0.3)


def _two(places: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    first, second = rng.choice(len(places), size=2, replace=False)
    return places[first], places[second]


def _shifted(pose: Array, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
    return pose + np.array([x, y, z, 0.0, 0.0, 0.0])
