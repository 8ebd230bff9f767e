"""Driving an arm along end-effector targets, frame by frame, and keeping what happened.

target_t ──> controller(q measured, target, upcoming) ──> joint command ──> driver (safety) ──> bus ──> arm
                      ^                                                                                 │
                      └────────────────────────────── q measured ──────────────────────────────────────┘
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_adapters.arm import Arm, ArmMode, ArmState, CommandResult
from robot_adapters.clock import Clock

Array = NDArray[np.float64]
Controller = Callable[[Array, Array, Array], Array]
"""Measured joints (dof,) [rad], the frame's target `T_base_tool` (7,) and those of all later frames (T, 7) to a joint
command (dof,) [rad]."""

_APPROACH_STEP = 0.05  # rad per frame on the way to where a trajectory begins
_SETTLING = 15  # frames there until the arm has caught up


@dataclass
class DeploymentLog:
    """What happened along one trajectory of T frames.

    Attributes:
        measured: Joints at the beginning of each frame [rad], (T, dof).
        before: Joint target in force before each command [rad], (T, dof): what a command is a step from.
        commanded: Joints that the controller asked for [rad], (T, dof).
        in_force: Joints that the driver made of it [rad], (T, dof).
        asked: Frames that were driven; fewer than T where the arm stopped.
        solve_ms: What the controller took, each frame.
        work_ms: Reading, solving and sending, each frame: what must fit into the period.
        period_ms: From the beginning of one frame to that of the next; on a simulated clock always the period.
        statuses: What the driver did with the commands, by name.
        events: Safety events, by name.
        stopped: Why the arm stopped, or empty.
    """

    measured: Array
    before: Array
    commanded: Array
    in_force: Array
    asked: int = 0
    solve_ms: list[float] = field(default_factory=list)
    work_ms: list[float] = field(default_factory=list)
    period_ms: list[float] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    events: Counter[str] = field(default_factory=Counter)
    stopped: str = ""


type Watcher = Callable[[int, Array, ArmState, Array, CommandResult], None]
"""Told of every frame: number, target, measured state, command, and what the driver made of it."""


def approach(arm: Arm, clock: Clock, q: Array, period: float) -> None:
    """Move from where the arm stands to `q` [rad] (dof,), slowly and joint by joint alike.

    Raises:
        RuntimeError: The arm stopped on the way; the message says why.
    """
    start = arm.read().q
    frames = int(np.ceil(np.abs(q - start).max() / _APPROACH_STEP))
    for share in [*np.linspace(0.0, 1.0, frames + 1)[1:], *[1.0] * _SETTLING]:
        result = arm.command(start + share * (q - start))
        if arm.mode is ArmMode.STOPPED:
            raise RuntimeError(
                f"the arm stopped on the way to the start: {'; '.join(e.message for e in result.events)}"
            )
        clock.sleep(period)


def drive(
    arm: Arm,
    clock: Clock,
    controller: Controller,
    targets: Array,
    fps: float,
    timer: Callable[[], float],
    watchers: Iterable[Watcher] = (),
) -> DeploymentLog:
    """Drive a connected arm along targets (T, 7), one a frame, and log it.

    A frame that is late is not made up for: the next one begins at once, and the period shows it. The drive
    ends early where the arm stops or a command is not finite.

    Args:
        arm: Connected, at rest near the beginning.
        clock: The arm's; on a simulated one the time between frames is simulated.
        controller: Asked once a frame.
        targets: `T_base_tool`, (T, 7).
        fps: Frames per second.
        timer: A clock for durations of computing [s], such as `time.perf_counter`.
        watchers: Told of every frame.
    """
    dof, period = len(arm.joint_names), 1.0 / fps
    measured, before, commanded, in_force = (np.full((len(targets), dof), np.nan) for _ in range(4))
    log = DeploymentLog(measured, before, commanded, in_force)
    watchers = list(watchers)
    due = began = clock.monotonic()
    for frame, target in enumerate(targets):
        now = clock.monotonic()
        if frame:
            log.period_ms.append((now - began) * 1e3)
        began, start = now, timer()
        state = arm.read()
        log.before[frame] = arm.target()
        asked = timer()
        command = controller(state.q, target, targets[frame + 1 :])
        log.solve_ms.append((timer() - asked) * 1e3)
        result = arm.command(command)
        log.work_ms.append((timer() - start) * 1e3)
        log.measured[frame], log.commanded[frame], log.in_force[frame] = state.q, command, result.q_sent
        log.asked = frame + 1
        log.statuses[result.status] += 1
        log.events.update(event.name for event in result.events)
        for watch in watchers:
            watch(frame, target, state, command, result)
        if arm.mode is ArmMode.STOPPED:
            log.stopped = "; ".join(event.message for event in result.events) or "the arm stopped"
            break
        if not np.isfinite(command).all():
            log.stopped = f"the controller answered {command.tolist()}"
            break
        due = max(due + period, clock.monotonic())
        clock.sleep(due - clock.monotonic())
    return log
