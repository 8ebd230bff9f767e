"""The keys of a terminal lead a simulated arm in end-effector space, through LeRobot's own command."""

import _thread
import importlib
import os
import signal
import sys
import termios
import threading
import time
from pathlib import Path

import lerobot_policy_mimicik  # noqa: F401 - registers the teleoperators, as LeRobot's commands do
import numpy as np
import pytest
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot_commands import run_here

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.point_chain import point_chain
from robot_adapters.robots.config_terminal_keyboard import TerminalKeyboardConfig

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
STILL = {"delta_x": 0.0, "delta_y": 0.0, "delta_z": 0.0, "gripper": 1.0}


@pytest.fixture
def terminal(monkeypatch):
    """Standard input is a terminal; a function that types into it."""
    ours, theirs = os.openpty()
    with os.fdopen(theirs) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)

        def type_keys(text):
            while termios.tcgetattr(stdin)[3] & termios.ICANON:  # nobody reads single keys yet
                time.sleep(0.02)
            os.write(ours, text)

        yield type_keys
    os.close(ours)


def make(tmp_path, **options):
    return make_teleoperator_from_config(TerminalKeyboardConfig(calibration_dir=tmp_path, **options))


def test_a_press_lasts_some_frames_and_the_other_direction_ends_it(tmp_path, terminal):
    keyboard = make(tmp_path)
    keyboard.connect()
    assert keyboard.get_action() == STILL
    keyboard.press("up")
    keyboard.press("W")
    keyboard.press("c")
    actions = [keyboard.get_action() for _ in range(4)]
    assert actions[:3] == [{"delta_x": 1.0, "delta_y": 0.0, "delta_z": 1.0, "gripper": 0.0}] * 3
    assert actions[3] == STILL
    for _ in range(50):
        keyboard.press("left")
    keyboard.press("right")
    assert [keyboard.get_action()["delta_y"] for _ in range(4)] == [-1.0, -1.0, -1.0, 0.0]
    for _ in range(50):
        keyboard.press("left")
    assert sum(keyboard.get_action()["delta_y"] for _ in range(100)) == 9.0  # it does not run on for long
    keyboard.disconnect()


def test_without_a_terminal_it_says_so(tmp_path, monkeypatch):
    with open(os.devnull) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with pytest.raises(ConnectionError, match="terminal"):
            make(tmp_path).connect()
    with pytest.raises(ValueError, match="frames_per_press=0"):
        TerminalKeyboardConfig(frames_per_press=0)


@pytest.fixture
def interruptible():
    """Ctrl-C interrupts, also where this process was started in the background and has ignored it since."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, signal.SIG_DFL if before is None else before)


@pytest.mark.usefixtures("interruptible")
def test_it_leads_an_so101_through_lerobots_command(terminal, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    example = importlib.import_module("replay_recordings")

    example.ObservedSim.commands = []
    ended = threading.Event()

    def frames(number):
        """Wait until the arm has been sent so many more commands."""
        more = len(example.ObservedSim.commands) + number
        while len(example.ObservedSim.commands) < more and not ended.wait(0.005):
            pass

    def lead():
        frames(2)
        for _ in range(8):
            terminal(b"w\x1b[D")  # up, left
            frames(6)
        frames(20)
        _thread.interrupt_main()  # as Ctrl-C does

    typist = threading.Thread(target=lead, daemon=True)
    typist.start()
    run_here(
        "lerobot.scripts.lerobot_teleoperate",
        "--robot.type=mimicik_ee",
        "--robot.arm.type=observed_sim",
        "--robot.arm.arm=so101",
        "--robot.arm.real_time=false",
        "--teleop.type=terminal_keyboard",
        "--fps=60",
        "--teleop_time_s=600",  # no verdict, only an end
    )
    ended.set()
    typist.join()
    chain = point_chain(describe_arm("so101"))
    begin, end = (chain.pose(q)[:3] for q in np.array(example.ObservedSim.commands)[[0, -1]])
    moved = end - begin
    # Eight presses of three frames of 2 mm each, or fewer where many came at once.
    assert 0.02 < moved[2] < 0.055
    assert 0.02 < moved[1] < 0.055
    assert abs(moved[0]) < 0.02
