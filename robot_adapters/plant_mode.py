"""The evaluation modes `plant` and `plant_commanded`: a solver drives the simulated arm over its bus.

In `plant` it is told what the arm measures, in `plant_commanded` the command in force. An AIRBOT Play that is streamed
positions lags them by 0.2 s: a solver that moves the measured joints by a bounded step never gets ahead of that
lag, while the command in force can be moved on at every frame.

Everything between command and measurement is there: driver, safety, 250 Hz interpolation, CAN frames, the motors'
lag, quantum and noise. Time is simulated, so that the result does not depend on how busy the computer is.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from lerobot_mimicik.evaluation.rollouts import Rollout, RolloutOptions, frame_bar, register_mode
from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.plausibility import joint_limits
from lerobot_mimicik.kinematics.poses import compose, inverse, pose_distance
from lerobot_mimicik.solvers.base import Array, IKSolver

FPS = 20.0
ARM = "airbot_play"  # the arm that these modes drive, one of `DRIVERS`
_SAME_PLACE = 0.02  # m: a calibrated URDF of the same arm moves the tool by some millimetres
_SAME_TURN = 0.1  # rad, likewise
_POSTURES = 8  # compared; two arms that agree in one or two by chance do not in so many


@register_mode("plant")
def plant(solver: IKSolver, trajectories: Sequence[Trajectory], options: RolloutOptions) -> list[Rollout]:
    """Each trajectory on an AIRBOT Play of its own, at 20 Hz, from where the recording begins.

    Raises:
        ValueError: Trajectories of another arm.
        ModuleNotFoundError: Without MuJoCo.
    """
    return _drive_all(solver, trajectories, options, measured=True)


@register_mode("plant_commanded")
def plant_commanded(
    solver: IKSolver, trajectories: Sequence[Trajectory], options: RolloutOptions
) -> list[Rollout]:
    """As `plant`, but the solver steps from the command in force, as `MimicIKAdapter` does by default."""
    return _drive_all(solver, trajectories, options, measured=False)


def _drive_all(
    solver: IKSolver, trajectories: Sequence[Trajectory], options: RolloutOptions, measured: bool
) -> list[Rollout]:
    from robot_adapters.deployment import drive
    from robot_adapters.drivers import simulated_cell

    for trajectory in trajectories:
        refuse_another_arm(trajectory)
    rollouts = []
    with frame_bar(sum(map(len, trajectories)), options.label, options.progress) as bar:
        for number, trajectory in enumerate(trajectories):
            with simulated_cell(ARM, q=trajectory.q[0], seed=options.seed + number) as cell:
                cell.arm.connect()
                solver.reset_one(trajectory.q[0])

                def ask(q: Array, target: Array, upcoming: Array) -> Array:
                    if solver.look_ahead:
                        solver.foresee(upcoming[: solver.look_ahead])
                    q = q if measured else cell.arm.target()
                    answer = solver.solve_one(q, target)
                    bar.update(1)
                    return np.asarray(answer)

                log = drive(cell.arm, cell.clock, ask, trajectory.target, FPS, time.perf_counter)
            # Steps are counted from command to command, as the arm's own protections count them.
            rollouts.append(Rollout(trajectory, log.before, log.commanded, log.asked))
    return rollouts


def refuse_another_arm(trajectory: Trajectory, name: str = ARM) -> None:
    """Refuse a motion that is not of the driven arm `name`, by its joints and, where its arm is known, by that.

    Tools may differ: between the two arms' tools there must be a constant pose, however the joints stand.

    Raises:
        ValueError: It is another arm's.
    """
    own, other = describe_arm(name), trajectory.arm
    beginning = f"the arm that is driven is {name}; trajectory {trajectory.index} is of another arm"
    dof = trajectory.q.shape[1]
    if dof != len(own.joint_names):
        raise ValueError(f"{beginning}, with {dof} joints: expected {len(own.joint_names)}")
    if other is None:
        return
    if other.joint_names != own.joint_names:
        raise ValueError(
            f"{beginning}, with joints {', '.join(other.joint_names)}: expected {', '.join(own.joint_names)}"
        )
    lower, upper = joint_limits(own)
    q = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, dof))
    between = compose(inverse(array_chain(own).pose(q)), array_chain(other).pose(q))
    apart = np.max([pose_distance(between[0], pose) for pose in between], axis=0)
    if (apart > (_SAME_PLACE, _SAME_TURN)).any():
        raise ValueError(
            f"{beginning}: its joints have the same names, but move the tool elsewhere (by {apart[0]:.3f} m, "
            f"{apart[1]:.2f} rad)"
        )
