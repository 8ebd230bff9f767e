"""What LeRobot imports on start-up: registers the policies and the robots, nothing heavy.

LeRobot finds plugins by distribution name and imports a module of the same name, which is why this
folder is installed as `lerobot_policy_mimicik`.
"""

import lerobot_mimicik.baselines.configuration_mlp
import lerobot_mimicik.baselines.configuration_unet
import lerobot_mimicik.configuration_foresight
import lerobot_mimicik.configuration_mimicik  # noqa: F401
import robot_adapters.robots.config_airbot_play
import robot_adapters.robots.config_mimicik_ee
import robot_adapters.robots.config_mimicik_sim
import robot_adapters.robots.config_recorded_motion
import robot_adapters.robots.config_terminal_keyboard  # noqa: F401
from robot_adapters.robots.short_names import claim_short_names

claim_short_names()
