"""Stock LeRobot commands drive the arm over its bus: rollout, record, replay, teleoperate, asynchronous client."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot_commands import run_console, run_here

from robot_adapters.wrapping import wrap_checkpoint

# LeRobot's commands wait in real time; the arm waits for a computer that is too busy for that.
VIRTUAL = ["--robot.interface=virtual", "--robot.real_time=false"]


def ee_robot(mimicik_run) -> list[str]:
    return [
        "--robot.type=airbot_play_ee",
        *VIRTUAL,
        "--robot.gripper=false",
        f"--robot.ik.path={mimicik_run}",
    ]


@pytest.fixture(scope="module")
def act_for_poses(act_run, tmp_path_factory):
    return wrap_checkpoint(str(act_run), None, tmp_path_factory.mktemp("wrapped") / "act_ee")


def test_rollout_of_an_end_effector_policy_on_the_end_effector_robot(act_for_poses, mimicik_run):
    output = run_console(
        "lerobot-rollout",
        f"--policy.path={act_for_poses}",
        *ee_robot(mimicik_run),
        "--fps=20",
        "--duration=4",
        "--device=cpu",
        "--play_sounds=false",
        "--return_to_initial_position=false",
    )
    assert "Rollout finished" in output
    assert "ArmStopped" not in output


def test_rollout_of_a_wrapped_policy_on_the_joint_space_robot(act_run, mimicik_run, tmp_path):
    wrapped = wrap_checkpoint(str(act_run), str(mimicik_run), tmp_path / "act_joints")
    output = run_here(
        "lerobot.scripts.lerobot_rollout",
        f"--policy.path={wrapped}",
        "--robot.type=airbot_play",
        *VIRTUAL,
        "--robot.gripper=false",
        "--fps=20",
        "--duration=4",
        "--device=cpu",
        "--play_sounds=false",
    )
    assert "Rollout finished" in output
    assert "JumpViolation" not in output


def test_record_with_a_teleoperator_then_replay(mimicik_run, tmp_path):
    recorded = tmp_path / "recorded"
    dataset = ["--dataset.repo_id=local/recorded", f"--dataset.root={recorded}"]
    run_here(
        "lerobot.scripts.lerobot_record",
        *ee_robot(mimicik_run),
        "--teleop.type=recorded_motion",
        f"--teleop.dataset_root={mimicik_run.parent / 'data' / 'test'}",
        "--teleop.column=observation.ee_target",
        *dataset,
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=5",
        "--dataset.reset_time_s=0",
        "--dataset.fps=20",
        "--dataset.single_task=follow the recording",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    found = LeRobotDataset("local/recorded", root=recorded)
    assert found.features["action"]["names"][:3] == ["ee.x.pos", "ee.y.pos", "ee.z.pos"]
    frames = found.hf_dataset.with_format("numpy")[:]
    state = frames["observation.state"]
    assert len(state) > 5  # many more on a free computer
    # How near it comes to a moving target in five seconds depends on how busy the computer is; it does move.
    assert np.abs(state[:, :3] - state[0, :3]).max() > 0.01
    output = run_here(
        "lerobot.scripts.lerobot_replay",
        *ee_robot(mimicik_run),
        *dataset,
        "--dataset.episode=0",
        "--play_sounds=false",
    )
    assert "ArmStopped" not in output


def test_teleoperate_in_joint_space(mimicik_run):
    output = run_here(
        "lerobot.scripts.lerobot_teleoperate",
        "--robot.type=airbot_play",
        *VIRTUAL,
        "--robot.gripper=false",
        "--robot.max_relative_target=0.05",
        "--teleop.type=recorded_motion",
        f"--teleop.dataset_root={mimicik_run.parent / 'data' / 'test'}",
        "--fps=20",
        "--teleop_time_s=3",
    )
    assert "JumpViolation" not in output


def test_asynchronous_inference(act_for_poses, mimicik_run, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    served, driven = tmp_path / "server.log", tmp_path / "client.log"
    with served.open("w") as server_log, driven.open("w") as client_log:
        # They write logs into the folder that they run in.
        server = _start("policy_server", tmp_path, server_log, "--host=127.0.0.1", f"--port={port}")
        client = None
        try:
            _wait(lambda: _listens(port), f"nobody listens on port {port}", served)
            client = _start(
                "robot_client",
                tmp_path,
                client_log,
                f"--server_address=127.0.0.1:{port}",
                *ee_robot(mimicik_run),
                "--task=follow",
                "--policy_type=act",
                f"--pretrained_name_or_path={act_for_poses}",
                "--policy_device=cpu",
                "--actions_per_chunk=10",
                "--fps=20",
            )
            # Later chunks are made of observations that follow the actions of earlier ones.
            again = re.compile(r"Action chunk #[1-9]\d* generated")
            _wait(lambda: again.search(served.read_text()), "no second chunk of actions", driven)
            client.send_signal(signal.SIGINT)
            client.wait(timeout=300)
        finally:
            for process in (client, server):
                if process is not None and process.poll() is None:
                    process.kill()
                    process.wait()
    output = driven.read_text()
    assert "ArmStopped" not in output, output[-4000:]


def _start(module: str, folder, log, *options: str) -> subprocess.Popen:
    command = [sys.executable, "-m", f"lerobot.async_inference.{module}", *options]
    return subprocess.Popen(command, cwd=folder, stdout=log, stderr=subprocess.STDOUT)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _wait(condition, complaint: str, log, seconds: float = 1200) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{complaint}:\n{log.read_text()[-4000:]}"
        time.sleep(0.2)
