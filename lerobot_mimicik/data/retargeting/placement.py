"""Placing a recorded motion in front of an arm: how large, where, turned which way.

A recording lives in its own frame and at human scale. A placement turns it about the vertical, scales it into
the arm's workspace box and lays its middle somewhere in the room that is left; its rotations are applied,
relative to their mean, to the tool orientation of the arm's home configuration, tilted a little:

    p(t) = centre + scale Rz(yaw) (p_rec(t) - middle)
    R(t) = Rz(yaw) exp(rotation_scale log(R_rec(t) R_mean^T)) Rz(yaw)^T  R_centre

Which placements an arm can follow is for inverse kinematics to say (see `retarget`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.home import find_home
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.trajectory_ik import (
    TrajectoryOptions,
    forward,
    solve_trajectories,
)

PAPER_WORKSPACE = (0.43, 0.40, 0.23)
"""Extent of the paper's recordings [m], of an arm whose joints beyond the shoulder reach 0.65 m."""
_PAPER_REACH = 0.6467


@dataclass(frozen=True)
class PlacementOptions:
    """Room and freedom of placements.

    Attributes:
        workspace: Extent of the box for the tool point along x, y, z [m]; empty: the paper's, scaled by
            reach.
        centre: Middle of that box in the base frame [m]; empty: before the home pose, as near as the box is
            reachable.
        max_scale: Largest factor on the recorded translation.
        max_rotation: Largest rotation away from a recording's mean orientation [rad]; larger ones are scaled
            down.
        max_tilt: Largest tilt of the mean tool orientation away from the home orientation [rad].
    """

    workspace: tuple[float, ...] = ()
    centre: tuple[float, ...] = ()
    max_scale: float = 1.0
    max_rotation: float = 1.2
    max_tilt: float = 0.5

    def __post_init__(self) -> None:
        for name in ("workspace", "centre"):
            if len(getattr(self, name)) not in (0, 3):
                raise ValueError(
                    f"{name} must be three lengths in metres or empty, got {getattr(self, name)}"
                )
        if self.workspace and min(self.workspace) <= 0:
            raise ValueError(f"workspace must be positive along every axis, got {self.workspace}")
        if self.max_scale <= 0 or self.max_rotation <= 0 or self.max_tilt < 0:
            raise ValueError(
                "max_scale and max_rotation must be positive and max_tilt not negative, got "
                f"{self.max_scale}, {self.max_rotation}, {self.max_tilt}"
            )


@dataclass(frozen=True)
class Workspace:
    """The box that recordings are placed into.

    Attributes:
        centre, size: Of the box in the base frame [m], shape (3,).
        home: Joints from which solutions are sought [rad], shape (dof,).
        quaternion_home: Tool orientation there, xyzw, shape (4,).
    """

    centre: np.ndarray
    size: np.ndarray
    home: np.ndarray
    quaternion_home: np.ndarray


@dataclass(frozen=True)
class Motion:
    """A recorded motion of T frames, relative to its own mean orientation.

    Attributes:
        position: As recorded [m], shape (T, 3).
        rotation: Rotation vector of R(t) R_mean^T in the recording's frame [rad], shape (T, 3).
    """

    position: np.ndarray
    rotation: np.ndarray

    @classmethod
    def of(cls, pose: np.ndarray) -> Motion:
        """The motion of poses (T, 7)."""
        rotations = Rotation.from_quat(pose[:, 3:])
        return cls(pose[:, :3], (rotations * rotations.mean().inv()).as_rotvec())


@dataclass(frozen=True)
class Placement:
    """One way to lay a recording before the arm; see the module's formula.

    Attributes:
        turn: Rz(yaw), shape (3, 3).
        scale, rotation_scale: Factors on translation and rotation.
        offset: Centre - scale Rz(yaw) middle [m], shape (3,).
        centre_quaternion: R_centre as xyzw, shape (4,).
    """

    turn: np.ndarray
    scale: float
    rotation_scale: float
    offset: np.ndarray
    centre_quaternion: np.ndarray

    def apply(self, motion: Motion, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Targets T_base_tool of the chosen frames of a motion, shape (rows, 7)."""
        position = self.offset + self.scale * motion.position[rows] @ self.turn.T
        vector = self.rotation_scale * motion.rotation[rows] @ self.turn.T
        return np.concatenate([position, _exp(vector) @ _right_product(self.centre_quaternion)], axis=1)


def propose(
    motion: Motion, workspace: Workspace, options: PlacementOptions, shrink: float, rng: np.random.Generator
) -> Placement:
    """A random placement that keeps the tool point of a motion inside the workspace box.

    Args:
        motion: What is placed.
        workspace: The box.
        options: Limits.
        shrink: Extra factor on translation and rotation, 1 at first and smaller after failures.
        rng: Source of yaw, place and tilt.
    """
    yaw = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    turned = motion.position @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = np.maximum(high - low, 1e-6)
    scale = min(options.max_scale, float((workspace.size / extent).min())) * shrink
    room = workspace.size - scale * extent
    centre = workspace.centre + room * rng.uniform(-0.5, 0.5, size=3)
    largest = float(np.sqrt((motion.rotation**2).sum(axis=1).max()))
    rotation_scale = min(1.0, options.max_rotation / max(largest, 1e-6)) * shrink
    direction = rng.normal(size=3)
    tilt = options.max_tilt * rng.uniform() ** (1 / 3) * direction / np.linalg.norm(direction)
    quaternion = _exp(tilt[None])[0] @ _right_product(workspace.quaternion_home)
    return Placement(turn, scale, rotation_scale, centre - scale * 0.5 * (low + high), quaternion)


def _exp(vector: np.ndarray) -> np.ndarray:
    """Quaternions xyzw (N, 4) of rotation vectors (N, 3)."""
    half = 0.5 * np.sqrt((vector**2).sum(axis=1, keepdims=True))
    return np.concatenate([0.5 * np.sinc(half / np.pi) * vector, np.cos(half)], axis=1)


def _right_product(quaternion: np.ndarray) -> np.ndarray:
    """The matrix M (4, 4) for which a @ M is the product of a and `quaternion`, xyzw."""
    x, y, z, w = quaternion
    return np.array([[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z], [x, y, z, w]])


def find_workspace(description: ArmDescription, options: PlacementOptions, floor: float | None) -> Workspace:
    """The box for an arm: as given, or the paper's scaled by reach and pulled back until the arm fills it.

    Deterministic. Raises ValueError if the tool cannot reach the middle of the box.
    """
    home = np.array(description.home) if description.home else find_home(description, floor)
    pose = forward(description, home[None])[0]
    size = np.array(options.workspace or np.array(PAPER_WORKSPACE) * _reach(description) / _PAPER_REACH)
    if options.centre:
        centre = np.array(options.centre)
        if not _reachable(description, home, pose, centre[None])[0]:
            raise ValueError(f"the arm does not reach the middle of its workspace, {tuple(centre)} m")
        return Workspace(centre, size, home, pose[3:])
    outward = pose[:3] * (1.0, 1.0, 0.0)
    distance = float(np.linalg.norm(outward))
    outward = outward / distance if distance > 1e-6 else np.array([1.0, 0.0, 0.0])
    grid = np.stack(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * size
    lowest = 0.02 + size[2] / 2 + (floor if floor is not None else -np.inf)
    best: tuple[int, np.ndarray] | None = None
    for back in np.linspace(0.0, 0.5, 6) * size[0]:
        centre = pose[:3] - back * outward
        centre[2] = max(centre[2], lowest)
        reached = int(np.count_nonzero(_reachable(description, home, pose, centre + grid)))
        if best is None or reached > best[0]:
            best = (reached, centre)
    assert best is not None
    return Workspace(best[1], size, home, pose[3:])


def _reachable(
    description: ArmDescription, home: np.ndarray, pose: np.ndarray, positions: np.ndarray
) -> np.ndarray:
    """Which positions (N, 3) the tool reaches in the home orientation, from home."""
    targets = [np.concatenate([position, pose[3:]])[None] for position in positions]
    options = TrajectoryOptions(iterations=0, approach_iterations=40)
    found = solve_trajectories(description, targets, np.tile(home, (len(targets), 1)), options)
    return np.array(
        [solution.position_error[0] < 1e-3 and solution.rotation_error[0] < 1e-2 for solution in found]
    )


def _reach(description: ArmDescription) -> float:
    """Length of the chain beyond the second joint, stretched [m]."""
    return array_chain(description).stretched_length(after=2)
