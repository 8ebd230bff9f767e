"""Arms of five, six and seven joints through the whole chain: data, training, stock rollout and recording, evaluation."""

import importlib
import json
import threading
import time
from concurrent import futures
from pathlib import Path

import draccus
import grpc
import numpy as np
import pytest
from lerobot.async_inference.configs import PolicyServerConfig, RobotClientConfig
from lerobot.async_inference.policy_server import PolicyServer
from lerobot.async_inference.robot_client import RobotClient
from lerobot.datasets import LeRobotDataset
from lerobot.transport import services_pb2_grpc
from lerobot_commands import run_here

from lerobot_mimicik.cli.main import main
from lerobot_mimicik.data.teleoperation.synthetic import make_synthetic
from lerobot_mimicik.kinematics.arms import describe_arm
from robot_adapters.adapter import IKStatus, MimicIKAdapter
from robot_adapters.wrapping import wrap_checkpoint

ARMS = ("so101", "piper", "panda")
ROOT = Path(__file__).resolve().parents[1]
QUIET = "--play_sounds=false"


def robot(arm: str) -> list[str]:
    """Poses in front of a simulated arm whose time passes with its actions."""
    inner = {"type": "mimicik_sim", "arm": arm, "real_time": "false", "fps": "20", "gripper": "false"}
    return ["--robot.type=mimicik_ee", *(f"--robot.arm.{key}={value}" for key, value in inner.items())]


@pytest.fixture(scope="module")
def act_for_poses(act_run, tmp_path_factory):
    return wrap_checkpoint(str(act_run), None, tmp_path_factory.mktemp("wrapped") / "act_ee")


@pytest.fixture(scope="module", params=ARMS)
def trained(request, tmp_path_factory):
    """An arm, the folder of its generated data, and a small MimicIK policy trained on it for 200 steps."""
    arm, folder = request.param, tmp_path_factory.mktemp(request.param)
    make_synthetic(folder / "data", 4, describe_arm(arm), ood=False, progress=False, workers=1)
    run_here(
        "lerobot.scripts.lerobot_train",
        f"--config_path={ROOT / 'configs' / 'small.json'}",
        f"--dataset.root={folder / 'data' / 'train'}",
        f"--output_dir={folder / 'run'}",
        "--policy.device=cpu",
        "--policy.d_model=16",
        "--policy.n_layers=1",
        "--policy.d_ff=32",
        "--batch_size=32",
        "--steps=200",
        "--save_freq=200",
    )
    return arm, folder


def test_a_policy_in_end_effector_space_drives_it_with_what_was_learned(act_for_poses, trained):
    arm, folder = trained
    output = run_here(
        "lerobot.scripts.lerobot_rollout",
        f"--policy.path={act_for_poses}",
        *robot(arm),
        f"--robot.ik.path={folder / 'run'}",
        "--fps=20",
        "--duration=2",
        "--device=cpu",
        QUIET,
    )
    assert "Rollout finished" in output
    assert "Returning robot to initial position" in output
    assert "Could not return" not in output


def test_poses_of_its_data_are_reached_and_evaluated(trained, capsys):
    arm, folder = trained
    adapter = MimicIKAdapter.from_pretrained(folder / "run")
    assert adapter.description.urdf == describe_arm(arm).urdf  # the dataset and the checkpoint carried it
    frames = LeRobotDataset("local/test", root=folder / "data" / "test").hf_dataset.with_format("numpy")[:20]
    for q, target in zip(frames["observation.state"], frames["observation.ee_target"], strict=True):
        adapter.reset()
        assert adapter.solve(q, target).status is IKStatus.REACHED
    options = ["--mode=closed_loop", "--solvers=mimicik_guided", "--episodes=1", "--latency_queries=3"]
    data = [f"--policy.path={folder / 'run'}", f"--dataset.root={folder / 'data' / 'test'}"]
    assert main(["eval", *data, *options, f"--output={folder / 'report'}"]) == 0
    capsys.readouterr()
    row = json.loads((folder / "report" / "report.json").read_text())["rows"][0]
    assert row["mean_mm"] < 1.0


@pytest.mark.parametrize("arm", ARMS)
def test_recorded_from_a_teleoperator_then_replayed(arm, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    example = importlib.import_module("replay_recordings")
    example.write(example.recordings(arm, 40)["circle"], tmp_path / "poses", fps=20)
    dataset = ["--dataset.repo_id=local/recorded", f"--dataset.root={tmp_path / 'recorded'}"]
    run_here(
        "lerobot.scripts.lerobot_record",
        *robot(arm),
        "--teleop.type=recorded_motion",
        f"--teleop.dataset_root={tmp_path / 'poses'}",
        *dataset,
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=3",
        "--dataset.reset_time_s=0",
        "--dataset.fps=20",
        "--dataset.single_task=follow the recording",
        "--dataset.push_to_hub=false",
        QUIET,
    )
    frames = LeRobotDataset("local/recorded", root=tmp_path / "recorded").hf_dataset.with_format("numpy")[:]
    state = frames["observation.state"]
    assert np.abs(state[:, 1:3] - state[0, 1:3]).max() > 0.02  # it went round, as far as the machine kept up
    np.testing.assert_allclose(
        state[-1, :3], frames["action"][-1, :3], atol=0.02
    )  # and ended where it was told
    output = run_here("lerobot.scripts.lerobot_replay", *robot(arm), *dataset, "--dataset.episode=0", QUIET)
    assert "failed:" not in output


@pytest.fixture(scope="module")
def policy_server():
    """LeRobot's policy server for asynchronous inference, in this process: it and its address."""
    server, service = grpc.server(futures.ThreadPoolExecutor(4)), PolicyServer(PolicyServerConfig())
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(service, server)
    address = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    server.start()
    yield address
    server.stop(None)


@pytest.mark.parametrize("arm", ARMS)
def test_the_asynchronous_client_drives_it(act_for_poses, policy_server, arm):
    options = [
        f"--server_address={policy_server}",
        *robot(arm),
        "--task=follow",
        "--policy_type=act",
        f"--pretrained_name_or_path={act_for_poses}",
        "--policy_device=cpu",
        "--actions_per_chunk=10",
        "--fps=20",
    ]
    client = RobotClient(draccus.parse(RobotClientConfig, args=options))
    face = client.robot.sides[""][1]
    assert client.start()
    threads = [
        threading.Thread(target=client.receive_actions, daemon=True),
        threading.Thread(target=client.control_loop, args=("follow",), daemon=True),
    ]
    try:
        for thread in threads:
            thread.start()
        end = time.monotonic() + 600
        while client.latest_action < 15:  # later chunks are made of observations that follow earlier actions
            assert time.monotonic() < end, "no second chunk of actions"
            time.sleep(0.05)
        assert face.result.status is not IKStatus.FAILED
    finally:
        client.stop()
        for thread in threads:
            thread.join()
