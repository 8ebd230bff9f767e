"""The arms that this project drives by itself: how each is opened, simulated and checked.

Another arm is a driver with the methods of `Arm` (for motors on a CAN bus: a subclass of `CanArm`) and an entry here.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

from lerobot_mimicik.kinematics.names import did_you_mean
from robot_adapters.arm import Arm, SimulatedArmCell
from robot_adapters.checks import ArmChecks
from robot_adapters.clock import Clock


@dataclass(frozen=True)
class Driver:
    """Where the parts of a driver are, as `module:class`; each is imported when it is used.

    Attributes:
        arm: An `Arm` made of interface, channel, `clock` and `handle_signals`.
        cell: A `SimulatedArmCell` made of a clock, `q` [rad], `payload` [kg], `seed` and `handle_signals`; empty:
            there is none.
        checks: `ArmChecks` made of interface, channel and clock; empty: there are none.
    """

    arm: str
    cell: str = ""
    checks: str = ""


DRIVERS = {
    "airbot_play": Driver(
        "robot_adapters.airbot.arm:AirbotArm",
        "robot_adapters.simulation.cell:SimulatedCell",
        "robot_adapters.airbot.checks:AirbotChecks",
    )
}


def open_arm(name: str, interface: str, channel: str | None, *, clock: Clock, **options: Any) -> Arm:
    """The driver of an arm on a bus, not yet connected.

    Raises:
        ValueError: No arm of that name is driven here.
    """
    return _made(name, driver_of(name).arm, "driver")(interface, channel, clock=clock, **options)


def simulated_cell(name: str, clock: Clock | None = None, **options: Any) -> SimulatedArmCell:
    """A simulated arm with its driver, not yet connected; a context manager.

    Raises:
        ValueError: No arm of that name is driven here, or it is not simulated.
        ModuleNotFoundError: MuJoCo is missing.
    """
    return _made(name, driver_of(name).cell, "simulated arm")(clock, **options)


def arm_checks(name: str, interface: str, channel: str | None, clock: Clock) -> ArmChecks:
    """What the doctor checks on the arm's bus. ValueError where there is no such arm, or nothing to check."""
    return _made(name, driver_of(name).checks, "check")(interface, channel, clock)


def driver_of(name: str) -> Driver:
    """The entry of an arm; ValueError with those that exist."""
    if name not in DRIVERS:
        raise ValueError(
            f"--arm={name}: no arm of that name is driven here; known are {', '.join(DRIVERS)}. Any arm that LeRobot "
            f"drives is reached through --robot.type=mimicik_ee.{did_you_mean(name, DRIVERS)}"
        )
    return DRIVERS[name]


def _made(name: str, where: str, what: str) -> Any:
    if not where:
        raise ValueError(f"--arm={name}: this arm has no {what}")
    module, _, attribute = where.partition(":")
    return getattr(importlib.import_module(module), attribute)
