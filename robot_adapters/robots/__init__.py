"""LeRobot robots. Configurations register on import; the robots themselves load when one is made."""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "AirbotPlay": "airbot_play",
    "AirbotPlayEE": "airbot_play",
    "BiAirbotPlay": "bi_airbot_play",
    "BiAirbotPlayEE": "bi_airbot_play",
    "MimicIKEE": "mimicik_ee",
    "MimicIKSim": "mimicik_sim",
    "RecordedMotion": "recorded_motion",
    "TerminalKeyboard": "terminal_keyboard",
}


def __getattr__(name: str) -> Any:
    # LeRobot looks for a robot's class beside its configuration's module.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
