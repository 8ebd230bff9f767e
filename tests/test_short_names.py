"""Another plugin registers `airbot_play` too: both work, in either order of import, and a word is said."""

import importlib
import logging
import sys

import lerobot_policy_mimicik  # noqa: F401 - the names as they are before anybody else comes
import pytest
from lerobot.robots.config import RobotConfig
from lerobot.utils.import_utils import register_third_party_plugins

from robot_adapters.robots import config_airbot_play
from robot_adapters.robots.short_names import SHORT_NAMES, claim_short_names
from robot_adapters.robots.spelling import own_keys

OTHER = "lerobot_robot_airbot_play"
MODULE = """
from dataclasses import dataclass
from lerobot.robots.config import RobotConfig

@RobotConfig.register_subclass("airbot_play")
@dataclass
class AIRBOTPlayConfig(RobotConfig):
    url: str = "localhost"
"""


@pytest.fixture
def other(tmp_path, monkeypatch):
    """An installed distribution of that name, and a process in which nobody has registered the short names yet."""
    (tmp_path / OTHER).mkdir()
    (tmp_path / OTHER / "__init__.py").write_text(MODULE)
    info = tmp_path / f"{OTHER}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {OTHER}\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    known = {name: each for name, each in RobotConfig.get_known_choices().items() if name not in SHORT_NAMES}
    monkeypatch.setattr(RobotConfig, "_choice_registry", known)
    yield
    sys.modules.pop(OTHER, None)


@pytest.mark.parametrize("ours_first", [True, False])
def test_both_are_known_whoever_comes_first(other, ours_first, caplog):
    def as_lerobot_does():
        importlib.import_module(OTHER)

    with caplog.at_level(logging.WARNING):
        for step in (
            (claim_short_names, as_lerobot_does) if ours_first else (as_lerobot_does, claim_short_names)
        ):
            step()
    known = RobotConfig.get_known_choices()
    assert known["airbot_play"].__name__ == "AIRBOTPlayConfig"
    assert known["airbot_play"](url="there").type == "airbot_play"
    assert known["airbot_play_can"] is config_airbot_play.AirbotPlayConfig
    assert known["airbot_play_ee"] is known["airbot_play_can_ee"]  # what nobody else wants stays
    assert f"is the robot of {OTHER}; this project's is --robot.type=airbot_play_can" in caplog.text


def test_lerobot_itself_imports_both(other, caplog):
    with caplog.at_level(logging.ERROR):
        register_third_party_plugins()
    claim_short_names()
    assert RobotConfig.get_known_choices()["airbot_play"].__module__ == OTHER
    assert "Could not import" not in caplog.text


def test_without_the_other_plugin_the_short_names_stay(monkeypatch):
    known = {name: each for name, each in RobotConfig.get_known_choices().items() if name not in SHORT_NAMES}
    monkeypatch.setattr(RobotConfig, "_choice_registry", known)
    claim_short_names()
    assert {name: known[name] for name in SHORT_NAMES} == SHORT_NAMES
    claim_short_names()  # twice is harmless


def test_joints_in_the_other_plugins_spelling():
    action = {"joint_1.pos": 1.0, "gripper.pos": 2.0, "Joint_2.pos": 3.0, "other": 4.0}
    keys = ["joint1.pos", "joint2.pos", "gripper.pos"]
    assert own_keys(action, keys) == {"joint1.pos": 1.0, "gripper.pos": 2.0, "joint2.pos": 3.0, "other": 4.0}
