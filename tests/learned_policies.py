"""What the tests of learned policies share: a policy as `lerobot-train` makes it, and runs of that command."""

from pathlib import Path

import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot_commands import run_here

from lerobot_mimicik.configuration_learned import LearnedIKConfig
from lerobot_mimicik.modeling_learned import LearnedIKPolicy


def prepared(config: LearnedIKConfig, root: Path) -> tuple[LearnedIKPolicy, dict[str, torch.Tensor]]:
    """A policy and one training batch of 64 samples."""
    offsets = [i / 20 for i in config.observation_delta_indices]
    keys = ("observation.state", "observation.ee_pose", "observation.ee_target")
    windows = dict.fromkeys(keys, offsets) | {"action": [i / 20 for i in config.action_delta_indices]}
    dataset = LeRobotDataset("local/teleop", root=root, delta_timestamps=windows)
    torch.manual_seed(0)
    policy = make_policy(config, ds_meta=dataset.meta)
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)
    return policy, preprocessor(next(iter(torch.utils.data.DataLoader(dataset, 64))))


def losses_of_training(policy: LearnedIKPolicy, batch: dict[str, torch.Tensor], steps: int) -> list[float]:
    """Losses of some steps on one batch, as LeRobot's loop makes them."""
    optimiser = torch.optim.AdamW(policy.get_optim_params(), 3e-3)
    policy.train()
    losses = []
    for _ in range(steps):
        loss, _ = policy.forward(batch)
        loss.backward()
        optimiser.step()
        optimiser.zero_grad()
        policy.update()
        losses.append(loss.item())
    return losses


def queries(policy: LearnedIKPolicy, count: int = 5) -> tuple[torch.Tensor, torch.Tensor]:
    """Joints (count, dof), rad, and target poses (count, 7) a little further."""
    q = 0.1 * torch.randn(count, policy.config.dof, generator=torch.Generator().manual_seed(1))
    return q, policy.arm.forward(q + 0.02)


def lerobot_train(*arguments: str) -> None:
    """Runs the command with what all runs here have in common."""
    run_here(
        "lerobot.scripts.lerobot_train",
        *arguments,
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--dataset.repo_id=local/teleop",
        "--batch_size=16",
        "--num_workers=0",
        "--log_freq=1",
        "--env_eval_freq=0",
    )
