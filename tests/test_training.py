"""Training with LeRobot's own commands: discovery, evaluation loss, resuming, fine-tuning, two processes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.scripts import lerobot_train
from lerobot_commands import ONE_THREAD, run_console, run_here
from safetensors.torch import load_file
from teleop import write_teleop

SMALL = [
    "--policy.type=mimicik",
    "--policy.d_model=32",
    "--policy.n_layers=1",
    "--policy.n_heads=2",
    "--policy.d_ff=32",
]
RUN = [
    "--policy.push_to_hub=false",
    "--policy.device=cpu",
    "--policy.optimizer_lr=1e-3",
    "--dataset.repo_id=local/teleop",
    "--num_workers=0",
    "--log_freq=1",
    "--env_eval_freq=0",
]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_teleop(tmp_path_factory.mktemp("data") / "teleop", episodes=6, frames=30)


@pytest.fixture
def lerobot_train_main(monkeypatch, capfd):
    """Runs the command's own `main` with arguments; returns the lines it logged."""

    def run(*arguments: str) -> list[str]:
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *arguments])
        capfd.readouterr()
        lerobot_train.main()
        printed = capfd.readouterr()
        return (printed.out + printed.err).splitlines()

    return run


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(run / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")


def test_console_command_knows_the_policy(root, tmp_path):
    """A fresh process, which imports none of this project: LeRobot finds the plugin by its distribution's name."""
    run_console(
        "lerobot-train", *SMALL, *RUN, f"--dataset.root={root}", f"--output_dir={tmp_path}/run", "--steps=2"
    )
    assert weights(tmp_path / "run")["training_step"] == 2


def test_evaluation_loss_on_held_out_episodes(root, tmp_path, lerobot_train_main):
    logged = lerobot_train_main(
        *SMALL, *RUN, f"--dataset.root={root}", f"--output_dir={tmp_path}/run", "--batch_size=16",
        "--steps=4", "--dataset.eval_split=0.3", "--eval_steps=2", "--save_checkpoint=false",
    )  # fmt: skip
    losses = [float(line.split("eval_loss=")[1].split()[0]) for line in logged if "eval_loss=" in line]
    assert len(losses) == 2
    assert all(loss > 0 for loss in losses)


@pytest.mark.parametrize("fk_update", ["separate", "joint"])
def test_resumed_run_equals_the_uninterrupted_one(root, tmp_path, lerobot_train_main, fk_update):
    common = [f"--dataset.root={root}", "--batch_size=16", "--save_freq=4", f"--policy.fk_update={fk_update}"]
    lerobot_train_main(*SMALL, *RUN, *common, "--steps=8", f"--output_dir={tmp_path}/whole")
    # Interrupted after four of eight steps: the checkpoint of step 4, and nothing after it.
    checkpoint = tmp_path / "whole" / "checkpoints" / "000004" / "pretrained_model"
    first = weights(tmp_path / "whole")
    logged = lerobot_train_main(
        f"--config_path={checkpoint}/train_config.json", "--resume=true", f"--output_dir={tmp_path}/resumed"
    )
    assert any("Resuming data order at epoch 0, sample 64" in line for line in logged)
    resumed = load_file(
        tmp_path / "resumed" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"
    )
    assert resumed["training_step"] == 8
    for name, value in first.items():
        torch.testing.assert_close(resumed[name], value, msg=lambda text, name=name: f"{name}: {text}")


def test_fine_tuning_keeps_the_checkpoints_statistics(root, tmp_path, lerobot_train_main):
    lerobot_train_main(
        *SMALL,
        *RUN,
        f"--dataset.root={root}",
        f"--output_dir={tmp_path}/first",
        "--steps=3",
        "--batch_size=16",
    )
    other = write_teleop(tmp_path / "other", episodes=2, frames=20, seed=9)
    lerobot_train_main(
        f"--policy.path={tmp_path}/first/checkpoints/last/pretrained_model", *RUN, "--batch_size=16",
        f"--dataset.root={other}", f"--output_dir={tmp_path}/second", "--steps=2",
    )  # fmt: skip
    before, after = weights(tmp_path / "first"), weights(tmp_path / "second")
    assert torch.equal(before["delta.lower"], after["delta.lower"])
    assert after["training_step"] == 5
    trained = "network.flow_map.final.linear.bias"
    assert not torch.equal(before[trained], after[trained])


def test_statistics_leave_the_evaluation_split_out(root, tmp_path, lerobot_train_main):
    lerobot_train_main(
        *SMALL, *RUN, f"--dataset.root={root}", f"--output_dir={tmp_path}/split", "--steps=1",
        "--batch_size=8", "--dataset.eval_split=0.5",
    )  # fmt: skip
    lerobot_train_main(
        *SMALL, *RUN, f"--dataset.root={root}", f"--output_dir={tmp_path}/chosen", "--steps=1",
        "--batch_size=8", "--dataset.episodes=[0,1,2]",
    )  # fmt: skip
    split, chosen = weights(tmp_path / "split"), weights(tmp_path / "chosen")
    for name in ("delta.lower", "delta.upper", "conditioning.relative.lower", "conditioning.position.upper"):
        torch.testing.assert_close(split[name], chosen[name])


def test_two_processes_equal_one(root, tmp_path, monkeypatch):
    """Ten steps under torchrun on gloo: equal weights on both ranks, and those of one process on the same batches."""
    arguments = [*SMALL, *RUN, f"--dataset.root={root}", "--steps=10", "--save_checkpoint=false"]
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        folder.mkdir()
    # Both ways to update in the same processes: those take longer to start than to train.
    monkeypatch.setenv("FK_UPDATES", "separate joint")
    monkeypatch.setenv("DUMP", str(one))
    run_here("train_and_dump", *arguments, "--batch_size=16")
    done = subprocess.run(
        [
            sys.executable, "-m", "torch.distributed.run", "--nproc_per_node=2", "--master_port=0",
            "--rdzv_backend=c10d", "--rdzv_endpoint=localhost:0",
            str(Path(__file__).with_name("train_and_dump.py")), *arguments, "--batch_size=8",
        ],
        env={**os.environ, **ONE_THREAD, "DUMP": str(two), "ACCELERATE_USE_CPU": "true"},
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    for fk_update in ("separate", "joint"):
        expected = load_file(one / f"{fk_update}-rank0.safetensors")
        first, second = (load_file(two / f"{fk_update}-rank{rank}.safetensors") for rank in (0, 1))
        assert first["training_step"] == 10
        for name, value in expected.items():
            assert torch.equal(first[name], second[name]), f"{fk_update}: {name} differs between ranks"
            torch.testing.assert_close(
                first[name], value, rtol=1e-4, atol=2e-5, msg=lambda text, name=name: f"{name}: {text}"
            )
        trained = torch.count_nonzero(expected["network.flow_map.final.linear.weight"])
        assert trained > 0, f"{fk_update}: the run did not train"
