"""The evaluation modes `plant` and `plant_commanded`: a solver drives the simulated arm over its bus.

In `plant` it is told what the arm measures, in `plant_commanded` the command in force. An AIRBOT Play that is streamed
positions lags them by 0.2 s: a solver that moves the measured joints by a bounded step never gets ahead of that
lag, while the command in force can be moved on at every frame.

Everything between command and measurement is there: driver, safety, 250 Hz interpolation, CAN frames, the motors'
lag, quantum and noise. Time is simulated, so that the result does not depend on how busy the computer is.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import numpy as np
from tqdm import tqdm

from lerobot_mimicik.evaluation.rollouts import Rollout, RolloutOptions, register_mode
from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.solvers.base import Array, IKSolver

FPS = 20.0


@register_mode("plant")
def plant(solver: IKSolver, trajectories: Sequence[Trajectory], options: RolloutOptions) -> list[Rollout]:
    """Each trajectory on an AIRBOT Play of its own, at 20 Hz, from where the recording begins.

    Raises:
        ValueError: trajectories of another arm.
        ModuleNotFoundError: without MuJoCo.
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
    from robot_adapters.simulation.cell import SimulatedCell

    rollouts = []
    with tqdm(
        total=sum(map(len, trajectories)),
        unit="frame",
        desc=options.label,
        disable=not options.progress,
        mininterval=0.2 if sys.stderr.isatty() else 10.0,
    ) as bar:
        for number, trajectory in enumerate(trajectories):
            with SimulatedCell(q=trajectory.q[0], seed=options.seed + number) as cell:
                if trajectory.q.shape[1] != len(cell.arm.joint_names):
                    raise ValueError(
                        f"modes plant drive an AIRBOT Play of {len(cell.arm.joint_names)} joints; the "
                        f"recordings have {trajectory.q.shape[1]}"
                    )
                cell.arm.connect()
                solver.reset(trajectory.q[:1] if solver.batched else trajectory.q[0])

                def ask(q: Array, target: Array) -> Array:
                    q = q if measured else cell.arm.target()
                    answer = (
                        solver.solve(q[None], target[None])[0] if solver.batched else solver.solve(q, target)
                    )
                    bar.update(1)
                    return np.asarray(answer)

                log = drive(cell.arm, cell.clock, ask, trajectory.target, FPS, time.perf_counter)
            # Steps are counted from command to command, as the arm's own protections count them.
            rollouts.append(Rollout(trajectory, log.before, log.commanded, log.asked))
    return rollouts
