"""A simulated arm, its driver and a bus between them: for tests, demonstrations and evaluation."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from numpy.typing import ArrayLike

from robot_adapters.airbot.arm import AirbotArm
from robot_adapters.airbot.protocol import Tool
from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.can.bus import open_bus
from robot_adapters.clock import Clock, SimulatedClock
from robot_adapters.simulation.faults import Fault
from robot_adapters.simulation.listener import BusListener
from robot_adapters.simulation.plant import PlantParameters
from robot_adapters.simulation.simulated_arm import SimulatedArm

_numbers = itertools.count()


class SimulatedCell:
    """`cell.arm` is an `AirbotArm` not yet connected, `cell.simulation` the arm behind it, on a virtual bus
    of their own.

    By default everything runs on a `SimulatedClock`: the cell's time passes in `cell.clock.sleep(seconds)`,
    and the same seed gives the same frames. With a `RealClock` arm and driver run in threads. A context
    manager that closes all; it does not connect the arm.
    """

    def __init__(
        self,
        clock: Clock | None = None,
        *,
        q: ArrayLike | None = None,
        settings: AirbotSettings | None = None,
        parameters: PlantParameters | None = None,
        payload: float = 0.0,
        tool: Tool = Tool.G2,
        faults: Iterable[Fault] = (),
        seed: int = 0,
        listen: bool = False,
        **arm_options: Any,
    ) -> None:
        """Arguments are those of `SimulatedArm` and `AirbotArm`; `payload` [kg] takes the place of the
        parameters'; `listen` adds a `BusListener` as `cell.listener`.
        """
        if payload:
            parameters = replace(parameters or PlantParameters(), payload=payload)
        self.clock: Clock = clock or SimulatedClock()
        self.channel = channel = f"airbot-cell-{next(_numbers)}"
        self._buses = [open_bus("virtual", channel)]
        self.simulation = SimulatedArm(
            self._buses[0], self.clock, parameters=parameters, q=q, tool=tool, faults=faults, seed=seed
        ).start()
        arm_options.setdefault("handle_signals", False)
        self.arm = AirbotArm("virtual", channel, settings=settings, clock=self.clock, **arm_options)
        self.listener: BusListener | None = None
        if listen:
            self._buses.append(open_bus("virtual", channel))
            gate = self.arm.gate
            self.listener = BusListener(self._buses[-1], self.clock, gate.lower, gate.upper).start()

    def freeze(self) -> None:
        """Have the driver do nothing, as a process does that was stopped or killed; simulated clock only."""
        if self.arm.schedule is not None:
            self.arm.schedule.paused = True

    def thaw(self) -> None:
        """Let a frozen driver go on."""
        if self.arm.schedule is not None:
            self.arm.schedule.paused = False

    def protections(self) -> dict[str, Any]:
        """What the arm's own protections counted."""
        return {
            "emergency_stop": self.simulation.emergency_stopped,
            "frames_above_0.1_rad": self.simulation.warnings,
            "largest_step_rad": round(self.simulation.largest_step, 4),
        }

    def close(self) -> None:
        """Close the driver, stop the simulation and close the bus. Closing twice is harmless."""
        if not self._buses:
            return
        self.thaw()
        self.arm.close()
        if self.listener is not None:
            self.listener.poll()
            self.listener.stop()
        self.simulation.stop()
        for bus in self._buses:
            bus.shutdown()
        self._buses = []

    def __enter__(self) -> SimulatedCell:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
