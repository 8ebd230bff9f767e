"""A LeRobot teleoperator that reads the keys of its terminal; its actions are those of LeRobot's `keyboard_ee`."""

from __future__ import annotations

import logging
import sys
import threading
from typing import Any

from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.keyboard_input import TerminalKeyListener

from robot_adapters.robots.config_terminal_keyboard import TerminalKeyboardConfig

_log = logging.getLogger(__name__)
_KEYS = {
    "up": ("delta_x", 1),
    "down": ("delta_x", -1),
    "left": ("delta_y", 1),
    "right": ("delta_y", -1),
    "w": ("delta_z", 1),
    "s": ("delta_z", -1),
    "o": ("gripper", 1),
    "c": ("gripper", -1),
}
"""Which number a key changes, and in which direction: x is ahead of the arm, y to its left, z up."""
_HELP = "arrows: ahead, back, left, right; w, s: up, down; o, c: open, close; Ctrl-C ends"
_MOST_PRESSES = 3  # that wait: the arm stops soon after a key that repeats is let go


class TerminalKeyboard(Teleoperator):
    """A terminal tells of presses, not of releases: each press moves the target for some frames."""

    config_class = TerminalKeyboardConfig
    name = "terminal_keyboard"

    def __init__(self, config: TerminalKeyboardConfig) -> None:
        super().__init__(config)
        self.config = config
        self._listener: Any = None
        self._left: dict[str, int] = {}  # frames that each number still changes for, with their sign
        self._lock = threading.Lock()

    @property
    def action_features(self) -> dict[str, type]:
        """Steps along x, y, z of the base frame, and the gripper: 0 closes, 1 stays, 2 opens."""
        return dict.fromkeys(("delta_x", "delta_y", "delta_z", "gripper"), float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether keys are read."""
        return self._listener is not None

    @property
    def is_calibrated(self) -> bool:
        """Always true."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Read keys from now on. Raises ConnectionError where the input is no terminal."""
        if not sys.stdin.isatty():
            raise ConnectionError(
                "no keys can be read: run this in a terminal, not with its input from elsewhere"
            )
        self._listener = TerminalKeyListener(self.press)
        self._listener.start()
        _log.warning("Keys of this terminal: %s.", _HELP)

    def press(self, key: str) -> None:
        """Take a key, by LeRobot's name for it; others than those of this teleoperator are left alone."""
        name, sign = _KEYS.get(key.lower(), ("", 0))
        if sign:
            most = _MOST_PRESSES * self.config.frames_per_press
            with self._lock:
                # A press to the other side ends what is left.
                left = max(sign * self._left.get(name, 0), 0) + self.config.frames_per_press
                self._left[name] = sign * min(left, most)

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """The steps of this frame."""
        with self._lock:
            signs = {name: (left > 0) - (left < 0) for name, left in self._left.items()}
            self._left = {name: left - signs[name] for name, left in self._left.items()}
        steps = {name: float(signs.get(name, 0)) for name in ("delta_x", "delta_y", "delta_z")}
        return {**steps, "gripper": 1.0 + signs.get("gripper", 0)}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Keys feel nothing."""

    @check_if_not_connected
    def disconnect(self) -> None:
        """Give the terminal back."""
        self._listener.stop()
        self._listener = None
