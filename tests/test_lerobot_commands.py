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
from trained import run_lerobot

from robot_adapters.wrapping import wrap_checkpoint


def ee_robot(mimicik_run) -> list[str]:
    return [
        "--robot.type=airbot_play_ee",
        "--robot.interface=virtual",
        "--robot.gripper=false",
        f"--robot.ik.path={mimicik_run}",
    ]


@pytest.fixture(scope="module")
def act_for_poses(act_run, tmp_path_factory):
    return wrap_checkpoint(str(act_run), None, tmp_path_factory.mktemp("wrapped") / "act_ee")


def test_rollout_of_an_end_effector_policy_on_the_end_effector_robot(act_for_poses, mimicik_run):
    output = run_lerobot(
        "scripts.lerobot_rollout",
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
    output = run_lerobot(
        "scripts.lerobot_rollout",
        f"--policy.path={wrapped}",
        "--robot.type=airbot_play",
        "--robot.interface=virtual",
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
    run_lerobot(
        "scripts.lerobot_record",
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
    state, action = frames["observation.state"], frames["action"]
    assert len(state) > 5  # many more on a free computer
    # The tool ends near where the operator led it, the arm's lag and a moving target allowed for.
    assert np.linalg.norm(state[-1, :3] - action[-1, :3]) < 0.05
    output = run_lerobot(
        "scripts.lerobot_replay",
        *ee_robot(mimicik_run),
        *dataset,
        "--dataset.episode=0",
        "--play_sounds=false",
    )
    assert "ArmStopped" not in output


def test_teleoperate_in_joint_space(mimicik_run):
    output = run_lerobot(
        "scripts.lerobot_teleoperate",
        "--robot.type=airbot_play",
        "--robot.interface=virtual",
        "--robot.gripper=false",
        "--robot.max_relative_target=0.05",
        "--teleop.type=recorded_motion",
        f"--teleop.dataset_root={mimicik_run.parent / 'data' / 'test'}",
        "--fps=20",
        "--teleop_time_s=3",
    )
    assert "JumpViolation" not in output


def test_asynchronous_inference(act_for_poses, mimicik_run):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    module = [sys.executable, "-m"]
    server = subprocess.Popen(
        [*module, "lerobot.async_inference.policy_server", "--host=127.0.0.1", f"--port={port}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    client = None
    try:
        _wait_for(port)
        client = subprocess.Popen(
            [
                *module,
                "lerobot.async_inference.robot_client",
                f"--server_address=127.0.0.1:{port}",
                *ee_robot(mimicik_run),
                "--task=follow",
                "--policy_type=act",
                f"--pretrained_name_or_path={act_for_poses}",
                "--policy_device=cpu",
                "--actions_per_chunk=10",
                "--fps=20",
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        lines = _read_until(client, r"Received action chunk", seconds=120)
        client.send_signal(signal.SIGINT)
        rest, _ = client.communicate(timeout=60)
        output = lines + rest
        assert "ArmStopped" not in output, output[-4000:]
        assert "Traceback" not in output.replace("KeyboardInterrupt", ""), output[-4000:]
    finally:
        for process in (client, server):
            if process is not None and process.poll() is None:
                process.kill()
                process.communicate()


def _wait_for(port: int, seconds: float = 90) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.2)
    raise AssertionError(f"nobody listens on port {port}")


def _read_until(process: subprocess.Popen, pattern: str, seconds: float) -> str:
    """Its output up to a line that matches."""
    end, lines = time.monotonic() + seconds, []
    assert process.stdout is not None
    while time.monotonic() < end:
        line = process.stdout.readline()
        if not line:
            break
        lines.append(line)
        if re.search(pattern, line):
            return "".join(lines)
    raise AssertionError("".join(lines)[-6000:])
