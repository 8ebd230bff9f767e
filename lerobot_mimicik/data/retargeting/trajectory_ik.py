"""Kept for users: `lerobot_mimicik.kinematics.trajectory_ik` under the name that it was first published as."""

from lerobot_mimicik.kinematics.trajectory_ik import (
    TrajectoryOptions,
    TrajectorySolution,
    forward,
    joint_range,
    pose_residual,
    solve_trajectories,
)

__all__ = [
    "TrajectoryOptions",
    "TrajectorySolution",
    "forward",
    "joint_range",
    "pose_residual",
    "solve_trajectories",
]
