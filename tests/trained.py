"""Checkpoints that the tests of the arm's side share, trained by `lerobot-train` itself in half a minute each."""

from __future__ import annotations

from pathlib import Path

from lerobot_commands import run_here

from lerobot_mimicik.data.teleoperation.session import SyntheticConfig
from lerobot_mimicik.data.teleoperation.synthetic import make_synthetic
from lerobot_mimicik.kinematics.arms import describe_arm

REPOSITORY = Path(__file__).resolve().parents[1]


def train_mimicik(folder: Path) -> Path:
    """A small MimicIK policy of the AIRBOT Play: its training run's folder. Data in `folder`/data."""
    make_synthetic(
        folder / "data",
        24,
        describe_arm("airbot_play"),
        seed=3,
        progress=False,
        workers=1,
        config=SyntheticConfig(ood_s=20.0),
    )
    run_here(
        "lerobot.scripts.lerobot_train",
        f"--config_path={REPOSITORY / 'configs' / 'small.json'}",
        f"--dataset.root={folder / 'data' / 'train'}",
        f"--output_dir={folder / 'mimicik'}",
        "--policy.device=cpu",
        "--policy.d_model=48",
        "--policy.d_ff=96",
        "--policy.n_layers=2",
        "--batch_size=256",
        "--steps=300",
        "--save_freq=300",
    )
    return folder / "mimicik"


def train_act(folder: Path) -> Path:
    """A small ACT policy in end-effector space: its training run's folder. Data in `folder`/ee."""
    make_synthetic(
        folder / "ee",
        12,
        describe_arm("airbot_play"),
        seed=4,
        ood=False,
        progress=False,
        workers=1,
        space="ee",
    )
    run_here(
        "lerobot.scripts.lerobot_train",
        "--policy.type=act",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--policy.chunk_size=10",
        "--policy.n_action_steps=10",
        "--policy.dim_model=64",
        "--policy.n_heads=4",
        "--policy.dim_feedforward=128",
        "--policy.n_encoder_layers=1",
        "--policy.n_decoder_layers=1",
        "--policy.use_vae=false",
        "--dataset.repo_id=local/ee",
        f"--dataset.root={folder / 'ee' / 'train'}",
        f"--output_dir={folder / 'act'}",
        "--batch_size=32",
        "--num_workers=0",
        "--steps=120",
        "--save_freq=120",
        "--env_eval_freq=0",
    )
    return folder / "act"
