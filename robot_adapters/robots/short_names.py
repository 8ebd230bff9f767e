"""The short names of the AIRBOT Play's robots, which another plugin registers too.

The robots here are `airbot_play_can`, `airbot_play_can_ee` and so on. The names without `can`, under which they were first
published, are theirs as well where nobody else has them: LeRobot drops the plugin that registers a name second.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging

from lerobot.robots.config import RobotConfig

from robot_adapters.robots.config_airbot_play import (
    AirbotPlayConfig,
    AirbotPlayEEConfig,
    BiAirbotPlayConfig,
    BiAirbotPlayEEConfig,
)

_log = logging.getLogger(__name__)
_OTHER = "lerobot_robot_airbot_play"
"""Distribution of the manufacturer's own plugin, which speaks with its gRPC server."""
SHORT_NAMES: dict[str, type[RobotConfig]] = {
    "airbot_play": AirbotPlayConfig,
    "airbot_play_ee": AirbotPlayEEConfig,
    "bi_airbot_play": BiAirbotPlayConfig,
    "bi_airbot_play_ee": BiAirbotPlayEEConfig,
}


def claim_short_names() -> None:
    """Register the short names that are free once the other plugin, where it is installed, has had its turn."""
    if importlib.util.find_spec(_OTHER) is not None:
        try:
            importlib.import_module(_OTHER)
        except Exception:
            # LeRobot imports it as well, and tells what is wrong with it.
            _log.debug("%s cannot be imported", _OTHER, exc_info=True)
    for name, config in SHORT_NAMES.items():
        known = RobotConfig.get_known_choices().get(name)
        if known is None:
            RobotConfig.register_subclass(name, config)
        elif known is not config:
            _log.warning(
                "--robot.type=%s is the robot of %s; this project's is --robot.type=%s",
                name,
                known.__module__.partition(".")[0],
                RobotConfig.get_choice_name(config),
            )
