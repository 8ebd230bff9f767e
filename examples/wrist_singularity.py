"""The picture of the README: an AIRBOT Play led through its wrist singularity by a hand that trembles by 1 mm.

An undamped pseudo-inverse (left) beside the guided solver (right), both in closed loop. Run it with
`uv run python examples/wrist_singularity.py docs/wrist.gif`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter
from new_solver import LeastSquares  # the example beside this one

from lerobot_mimicik.evaluation.rollouts import make_rollouts
from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.kinematics.poses import PoseFormat, compose, decode_pose
from lerobot_mimicik.kinematics.tremor import tremor
from lerobot_mimicik.solvers import IKSolver, make_solver
from lerobot_mimicik.solvers.base import Array

ARM = describe_arm("airbot_play")
FPS, SECONDS = 20, 6.0
_FROM, _TO = -0.6, 0.6  # rad: joint 5, which is 0 where the wrist is stretched and joints 4 and 6 are in line
_TREMOR_MM = 1.0
_EVERY = 3  # frames of the motion per frame of the picture
_COLOURS = ("tab:red", "tab:green")
_BARS = (3, 5)  # the links that joints 4 and 6 turn
_LINKS = [describe_arm("airbot_play", tip_link=joint.child) for joint in ARM.chain()]


def motion(seed: int = 0) -> Trajectory:
    """Joints that lead through the singularity, and the poses that a trembling hand asks for meanwhile."""
    phase = np.linspace(0.0, 1.0, round(SECONDS * FPS))
    q = np.tile(np.array(ARM.home), (len(phase), 1))
    q[:, 4] = _FROM + (_TO - _FROM) * phase**3 * (10 - 15 * phase + 6 * phase**2)
    q[:, 0] += 0.3 * phase
    poses = np.array([point_chain(ARM).pose(row) for row in q])
    shaking = tremor(len(q), FPS, _TREMOR_MM, np.random.default_rng(seed))
    return Trajectory(0, q, compose(poses, decode_pose(shaking, PoseFormat.ROTATION_VECTOR)))


def solvers() -> dict[str, IKSolver]:
    """The two that are shown, by what the picture calls them."""
    arm = SerialArm(ARM)
    return {"undamped pseudo-inverse": LeastSquares(arm, damping=0.0), "guided": make_solver("guided", arm)}


def commands(solver: IKSolver, trajectory: Trajectory) -> Array:
    """The first joints and the commands after them (T + 1, dof) [rad], in closed loop."""
    rollout = make_rollouts("closed_loop", solver, [trajectory])[0]
    return np.concatenate([rollout.q_curr[:1], rollout.q_cmd])


def joint_steps(q: Array) -> Array:
    """Largest motion of a joint at each frame (T,) [rad], of joints (T + 1, dof)."""
    return np.abs(np.diff(q, axis=0)).max(axis=1)


def draw(moved: dict[str, Array], trajectory: Trajectory, path: Path, frames: int | None = None) -> None:
    """Write the animation; `frames` shortens it."""
    matplotlib.use("Agg")
    figure = plt.figure(figsize=(6.4, 4.0), dpi=75)
    grid = figure.add_gridspec(
        2, 2, height_ratios=[3, 1.1], left=0.1, right=0.98, top=0.93, bottom=0.12, hspace=0.05
    )
    drawn = []
    below = figure.add_subplot(grid[1, :])
    times = np.arange(len(trajectory)) / FPS
    for column, ((name, q), colour) in enumerate(zip(moved.items(), _COLOURS, strict=True)):
        panel = figure.add_subplot(grid[0, column], projection="3d")
        tool = np.array([point_chain(ARM).pose(row)[:3] for row in q])
        panel.plot(*trajectory.target[:, :3].T, color="0.6", lw=2)
        (arm,) = panel.plot([], [], [], color="0.2", lw=3, marker="o", ms=4)
        wrist = [panel.plot([], [], [], color=colour, lw=4)[0] for _ in _BARS]
        (trace,) = panel.plot([], [], [], color=colour, lw=1)
        panel.set(xlim=(0.0, 0.5), ylim=(-0.2, 0.3), zlim=(0.0, 0.45))
        panel.set_title(name, y=0.97, fontsize=10, color=colour)
        panel.set_axis_off()
        panel.view_init(elev=25, azim=-70)
        panel.set_box_aspect((50, 50, 45), zoom=1.35)
        below.semilogy(times, np.maximum(joint_steps(q), 1e-4), color=colour, lw=1, label=name)
        drawn.append((q, tool, arm, wrist, trace))
    below.set(xlim=(0, times[-1]), ylim=(1e-3, 10))
    below.set_xlabel("s", fontsize=8, labelpad=0)
    below.set_ylabel("joint step [rad]", fontsize=8)
    below.tick_params(labelsize=7)
    cursor = below.axvline(0.0, color="0.5", lw=0.8)

    def show(frame: int) -> list:
        t = frame * _EVERY
        cursor.set_xdata([times[t], times[t]])
        for q, tool, arm, wrist, trace in drawn:
            skeleton, bars = _drawing(q[t + 1])
            arm.set_data_3d(*skeleton.T)
            for line, bar in zip(wrist, bars, strict=True):
                line.set_data_3d(*bar.T)
            trace.set_data_3d(*tool[: t + 2].T)
        return []

    count = frames or (len(trajectory) - 1) // _EVERY + 1
    path.parent.mkdir(parents=True, exist_ok=True)
    FuncAnimation(figure, show, frames=count).save(path, PillowWriter(fps=FPS // _EVERY))
    plt.close(figure)


def _drawing(q: Array) -> tuple[Array, list[Array]]:
    """Origins of base and links (n, 3) [m], and a bar (2, 3) across each link whose turning would not be seen."""
    named = dict(zip(ARM.joint_names, q, strict=True))
    frames = [
        point_chain(link).rotation_position_jacobian(np.array([named[name] for name in link.joint_names]))
        for link in _LINKS
    ]
    origins = np.array([np.zeros(3), *(position for _, position, _ in frames)])
    ends = np.outer([-0.04, 0.04], [1.0, 0.0, 0.0])  # m, along the link's x axis; joints turn about z
    return origins, [frames[link][1] + ends @ frames[link][0].T for link in _BARS]


def main(path: str = "docs/wrist.gif") -> dict[str, float]:
    """Drive both and write the picture; the largest joint step of each [rad]."""
    trajectory = motion()
    moved = {name: commands(solver, trajectory) for name, solver in solvers().items()}
    draw(moved, trajectory, Path(path))
    largest = {name: float(joint_steps(q).max()) for name, q in moved.items()}
    for name, step in largest.items():
        tool = np.array([point_chain(ARM).pose(q)[:3] for q in moved[name][1:]])
        error = np.linalg.norm(tool - trajectory.target[:, :3], axis=1) * 1e3
        print(
            f"{name}: largest joint step {step:.3f} rad, error mean {error.mean():.2f} mm, max {error.max():.2f}"
        )
    return largest


if __name__ == "__main__":
    main(*sys.argv[1:])
