"""The motors' own protection against jumping commands, as the paper's platform has it."""

from __future__ import annotations

from collections import deque

WARNING_STEP = 0.1  # rad per 20 Hz frame
EMERGENCY_STEP = 0.5
_FRAME = 0.05  # s
# Frames that travelled unequally long must not make two commands 50 ms apart look like one frame's, nor the
# quantum of the position code a step.
_JITTER, _QUANTUM = 0.005, 0.001


class StepProtection:
    """Watches the commanded positions of one motor over each frame of 50 ms: a warning above 0.1 rad, a stop
    above 0.5.
    """

    def __init__(self) -> None:
        self.warnings = 0
        self.tripped = False
        self.largest_step = 0.0
        self._recent: deque[tuple[float, float]] = deque()
        self._quiet_until = float("-inf")

    def watch(self, position: float | None, measured: float, now: float) -> bool:
        """Take a commanded position [rad], None where the command holds none; True when the motor must stop.

        The first command after none is compared with the measured position.
        """
        if position is None:
            self._recent.clear()
            return False
        recent = self._recent
        if not recent:
            recent.append((now, measured))
        while len(recent) > 1 and recent[0][0] < now - _FRAME + _JITTER:
            recent.popleft()
        step = max([abs(position - before) for _, before in recent]) - _QUANTUM
        recent.append((now, position))
        self.largest_step = max(self.largest_step, step)
        if step > EMERGENCY_STEP:
            self.tripped = True
        elif step > WARNING_STEP and now >= self._quiet_until:
            self.warnings += 1
            self._quiet_until = now + _FRAME
        return self.tripped
