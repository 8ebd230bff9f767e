"""The fault campaign: seeded faults while the arm tracks, each judged by how the arm and its commands ended.

Every case runs in simulated time on a bus of its own with an independent listener. What a fault may lead to
is stated here as a rule of its kind and length, not read from the driver.
"""

from __future__ import annotations

import enum
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.airbot.startup import RangeError
from robot_adapters.arm import ArmMode, StartRefusedError
from robot_adapters.can.bus import BusError
from robot_adapters.safety import CommandStatus, FollowingError, SafetyEvent, SafetyLimits
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.disturbances import Disturbance
from robot_adapters.simulation.faults import (
    DISTURBANCES,
    SENSOR_FAULTS,
    Fault,
    FaultKind,
    random_fault,
)

_FAULT_AT = 0.2  # s after the start of tracking
_LONGEST = 1.2  # s of a lasting fault that are watched
_WATCHED = 0.4  # s watched after the end of a fault
_PERIOD = 0.05  # s between targets
# How far an angle may be from the truth [rad] and how long [s] before the driver must have noticed, and how far the
# arm may travel [rad] on its way to rest after false feedback was noticed.
_WRONG, _NOTICED, _TRAVEL = 0.15, 0.5, 0.15
_GRACE = 0.02  # s: some ticks of the loop and some frames of debouncing

_ALWAYS_SHOW = (
    FaultKind.JUMPED_ENCODER,
    FaultKind.SATURATED_ENCODER,
    FaultKind.DRIFTING_ENCODER,
    FaultKind.SLIPPED_ZERO,
    FaultKind.LYING_VELOCITY,
    FaultKind.HEATING,
)

# What somebody else does to a motor, and the event that must say so within `_NOTICED` [s].
_INTRUSIONS = {
    FaultKind.OTHER_MASTER: "ForeignMaster",
    FaultKind.LIMP_MASTER: "ForeignMaster",
    FaultKind.HIDDEN_MASTER: "ForeignMaster",
    FaultKind.ONE_ORDER: "ForeignMaster",
    FaultKind.REPLAYED: "ForeignMaster",
    FaultKind.CONTROL_MODE: "WrongControlMode",
}


class FaultOutcome(enum.StrEnum):
    """How a case ended, from mild to severe."""

    TRACKING = "tracking"  # never anything but tracking
    HOLD = "hold"  # held for a while; tracking or holding at the end
    STOP = "stop"  # stopped, or did not start


@dataclass(frozen=True)
class FaultCase:
    """One case of the campaign: what was done, how it ended and what was wrong with that, if anything."""

    seed: int
    fault: Fault
    outcome: FaultOutcome
    events: tuple[str, ...]
    complaints: tuple[str, ...]
    commands: int
    largest_step: float


@dataclass
class CampaignReport:
    """All cases; `passed` when none of them has a complaint."""

    cases: list[FaultCase] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every case ended as specified without a violating frame."""
        return not self.failures

    @property
    def failures(self) -> list[FaultCase]:
        """The cases with complaints."""
        return [case for case in self.cases if case.complaints]

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Number of outcomes by kind of fault."""
        found = Counter((case.fault.kind.value, case.outcome.value) for case in self.cases)
        kinds = sorted({kind for kind, _ in found})
        return {kind: {end: n for (k, end), n in sorted(found.items()) if k == kind} for kind in kinds}

    @property
    def commands(self) -> int:
        """Command frames that the listeners judged."""
        return sum(case.commands for case in self.cases)


def run_campaign(count: int, seed: int = 0, kinds: Sequence[FaultKind] = tuple(FaultKind)) -> CampaignReport:
    """Run `count` cases with faults of `kinds`; the same seed gives the same report."""
    return CampaignReport(list(campaign_cases(count, seed, kinds)))


def campaign_cases(
    count: int, seed: int = 0, kinds: Sequence[FaultKind] = tuple(FaultKind)
) -> Iterator[FaultCase]:
    """The cases of `run_campaign` as they are done."""
    for number in range(count):
        case_seed = seed * 1_000_003 + number
        random = np.random.default_rng(case_seed)
        yield run_case(random_fault(random, _FAULT_AT, kinds), case_seed)


def run_case(fault: Fault, seed: int = 0) -> FaultCase:
    """Track a smooth motion, let the fault strike, `fault.start` after tracking began, and watch."""
    random = np.random.default_rng(seed)
    amplitude, phase = random.uniform(0.05, 0.35, 6), random.uniform(0.0, 2 * math.pi, 6)
    end = _FAULT_AT + min(fault.duration, _LONGEST) + _WATCHED
    quick = AirbotSettings(shutdown=0.02)
    faults = [fault] if fault.start == 0 else ()
    with SimulatedCell(seed=seed, listen=True, settings=quick, faults=faults) as cell:
        assert cell.listener is not None
        modes: list[ArmMode] = []
        names: list[str] = []
        disturbance = Disturbance(cell, fault, seed)
        if fault.start == 0:
            disturbance.begin()
        truth = _TruthWatch(cell)
        try:
            cell.arm.connect()
        except (BusError, RangeError, StartRefusedError) as error:
            names.append(type(error).__name__)
            outcome = FaultOutcome.STOP
        else:
            start = cell.clock.monotonic()
            if fault.start > 0:
                moved = Fault(
                    fault.kind,
                    fault.motor_id,
                    start + fault.start,
                    fault.duration,
                    fault.rate,
                    fault.magnitude,
                )
                cell.simulation.faults.faults.append(moved)
            home = cell.arm.read().q
            begun, ended = fault.start == 0, False
            while (t := cell.clock.monotonic() - start) < end:
                if not begun and t >= fault.start:
                    disturbance.begin()
                    begun = True
                if not ended and t >= fault.start + fault.duration - 1e-9:
                    disturbance.end()
                    ended = True
                if disturbance.frozen:
                    cell.clock.sleep(_PERIOD / 5)
                    continue
                wave = amplitude * (np.sin(1.2 * t + phase) - np.sin(phase))
                result = cell.arm.command(home + wave)
                names += [event.name for event in result.events]
                if result.status is not CommandStatus.REFUSED:
                    cell.listener.expect_motion()
                for _ in range(5):
                    cell.clock.sleep(_PERIOD / 5)
                    modes.append(cell.arm.mode)
                    events = cell.arm.events()
                    names += [event.name for event in events]
                    truth.watch(events)
            cell.listener.expect_motion()
            outcome = _outcome(modes)
            if fault.kind is FaultKind.KILLED:
                outcome = FaultOutcome.STOP if disturbance.let_go else FaultOutcome.TRACKING
        disturbance.close()
        complaints = _complaints(cell, fault, outcome, modes, names) + disturbance.complaints
        complaints += truth.complaints(fault)
        commands, largest = cell.listener.commands, cell.listener.largest_step
    complaints += [f"on the bus: {violation}" for violation in cell.listener.violations[:3]]
    return FaultCase(seed, fault, outcome, tuple(dict.fromkeys(names)), tuple(complaints), commands, largest)


class _TruthWatch:
    """Compares what the driver says and does with the true joint angles of the simulated arm."""

    def __init__(self, cell: SimulatedCell) -> None:
        self._cell = cell
        self._wrong_since: float | None = None
        self._held: NDArray[np.float64] | None = None
        self._off: NDArray[np.float64] = np.zeros(0)
        self.longest_wrong = self.travel = 0.0

    def watch(self, events: tuple[SafetyEvent, ...]) -> None:
        """Look at the arm now; `events` are those since the last call."""
        arm, simulation, listener = self._cell.arm, self._cell.simulation, self._cell.listener
        now = self._cell.clock.monotonic()
        # An arm that yields to what pushes it is the one that may move its commands after an event.
        if listener and any(not isinstance(event, FollowingError) for event in events):
            listener.expect_stillness()
        wrong = bool(np.any(np.abs(arm.read().q - simulation.q) > _WRONG))
        # A hold is an answer too: the driver has said that it does not trust the feedback, and nothing is tracked by it.
        if not wrong or arm.mode is not ArmMode.TRACKING:
            self._wrong_since = None
        elif self._wrong_since is None:
            self._wrong_since = now
        if self._wrong_since is not None:
            self.longest_wrong = max(self.longest_wrong, now - self._wrong_since)
        if arm.mode is not ArmMode.STOPPED:
            self._held = None
            return
        # A lagging arm still comes to where it is held; none may go further from there than it was. That what is held
        # does not move itself is the listener's to say.
        if self._held is None:
            self._held = arm.target().copy()
            self._off = np.abs(simulation.q - self._held)
        self.travel = max(self.travel, float(np.max(np.abs(simulation.q - self._held) - self._off)))

    def complaints(self, fault: Fault) -> list[str]:
        """What was wrong with that."""
        found = []
        if self.longest_wrong > _NOTICED + _GRACE:
            found.append(f"did not notice in {self.longest_wrong:.2f} s that an angle was wrong")
        # A motor that is too hot is relieved of its load, and its joint sinks.
        if fault.kind in SENSOR_FAULTS and fault.kind is not FaultKind.HEATING and self.travel > _TRAVEL:
            found.append(f"a joint moved away by {self.travel:.3f} rad after the stop")
        return found


def specified_outcomes(fault: Fault, limits: SafetyLimits | None = None) -> set[FaultOutcome]:
    """The outcomes that a fault may have.

    Damaged or missing frames lead to tracking, or to a hold where feedback stays away for more than its
    timeout, or to a stop where it does for more than the timeout of a lost motor. Errors, heat and a
    controller off the bus lead to a stop, wrong ranges to no start. False feedback leads to a stop where it must
    show whatever the arm does, else to a stop or tracking: then `_TruthWatch` judges.
    """
    limits = limits or SafetyLimits()
    stops = (FaultKind.MOTOR_ERROR, FaultKind.OVER_TEMPERATURE, FaultKind.BUS_OFF, FaultKind.WRONG_RANGES)
    if fault.kind in (*stops, *_ALWAYS_SHOW, FaultKind.CONTROL_MODE):
        return {FaultOutcome.STOP}
    if fault.kind in DISTURBANCES:
        return _disturbed_outcomes(fault, limits)
    if fault.kind in SENSOR_FAULTS:
        return {
            FaultOutcome.TRACKING,
            FaultOutcome.STOP,
            *([FaultOutcome.HOLD] if fault.kind is FaultKind.NOISY_ENCODER else []),
        }
    if fault.kind is FaultKind.DUPLICATED:
        return {FaultOutcome.TRACKING}
    silence = fault.duration if fault.kind is not FaultKind.DELAYED else min(fault.duration, fault.magnitude)
    certain = fault.kind is FaultKind.SILENT_MOTOR or (fault.kind is FaultKind.DROPPED and fault.rate == 1.0)
    allowed = set() if certain and silence > limits.feedback_timeout + _GRACE else {FaultOutcome.TRACKING}
    if silence > limits.feedback_timeout - _GRACE:
        allowed.add(FaultOutcome.HOLD)
    if silence > limits.lost_timeout - _GRACE:
        allowed.add(FaultOutcome.STOP)
        if certain and silence > limits.lost_timeout + _GRACE:
            allowed.discard(FaultOutcome.HOLD)
    if fault.kind is FaultKind.DELAYED and silence > limits.feedback_timeout - _GRACE:
        # Angles that are as old as stale ones may contradict the commands before they are called stale.
        allowed.add(FaultOutcome.STOP)
    return allowed


def _disturbed_outcomes(fault: Fault, limits: SafetyLimits) -> set[FaultOutcome]:
    """A second driver and traffic for others disturb nobody; a driver that stood still holds when its targets are
    old, and stops when the motors have let go. All else is another master, a motor lost or a dead driver.
    """
    if fault.kind in (FaultKind.SECOND_DRIVER, FaultKind.BUSY_BUS):
        return {FaultOutcome.TRACKING}
    if fault.kind is not FaultKind.FROZEN:
        return {FaultOutcome.STOP}
    timeout = AirbotSettings().motor_timeout
    if timeout is not None and fault.duration > timeout:
        return {FaultOutcome.STOP}
    # The last target may be a period old when the driver freezes.
    old = fault.duration + _PERIOD > limits.target_timeout
    return {FaultOutcome.HOLD} if old else {FaultOutcome.TRACKING}


def _outcome(modes: list[ArmMode]) -> FaultOutcome:
    # The loop holds until the first target comes.
    if ArmMode.STOPPED in modes:
        return FaultOutcome.STOP
    return FaultOutcome.HOLD if ArmMode.HOLD in modes[1:] else FaultOutcome.TRACKING


def _complaints(
    cell: SimulatedCell, fault: Fault, outcome: FaultOutcome, modes: list[ArmMode], names: list[str]
) -> list[str]:
    complaints = []
    allowed = specified_outcomes(fault)
    if outcome not in allowed:
        complaints.append(f"ended in {outcome}, specified: {', '.join(sorted(allowed))}")
    if fault.kind in _INTRUSIONS:
        complaints += _unnoticed(cell, fault, modes, names)
    if cell.simulation.emergency_stopped:
        complaints.append("the motors stopped in emergency")
    if fault.duration < _LONGEST and outcome is not FaultOutcome.STOP and modes[-1] is not ArmMode.TRACKING:
        complaints.append("did not track again after the fault was over")
    return complaints


def _unnoticed(cell: SimulatedCell, fault: Fault, modes: list[ArmMode], names: list[str]) -> list[str]:
    """What a driver that somebody else disturbs did not notice, or not in time."""
    if not modes:  # it did not start
        sent = cell.listener.commands if cell.listener is not None else 0
        return [f"sent {sent} commands to an arm that somebody else commands"] if sent else []
    if ArmMode.STOPPED not in modes:
        return []
    complaints = []
    after = modes.index(ArmMode.STOPPED) * _PERIOD / 5 - fault.start
    if after > _NOTICED + _PERIOD:
        complaints.append(f"noticed after {after:.2f} s")
    if _INTRUSIONS[fault.kind] not in names:
        complaints.append(f"stopped by {names}, not by {_INTRUSIONS[fault.kind]}")
    return complaints
