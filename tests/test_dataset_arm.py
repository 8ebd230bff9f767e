"""Training takes the dataset's own arm and refuses numbers that cannot be that arm's, as LeRobot builds the policy."""

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import make_policy
from teleop import write_teleop
from test_trajectories import change_column

from lerobot_mimicik.baselines.configuration_mlp import MLPConfig
from lerobot_mimicik.kinematics.arms import describe_arm


def small(**options):
    return MLPConfig(device="cpu", hidden_dim=8, n_layers=1, **options)


def policy_for(root, config):
    """A new policy for a dataset, made by LeRobot's own function while the dataset is open, as in training."""
    dataset = LeRobotDataset("local/teleop", root=root)
    return make_policy(config, ds_meta=dataset.meta)


def test_the_policy_has_the_datasets_arm(tmp_path):
    root = write_teleop(tmp_path / "piper", episodes=1, frames=10, robot="piper")
    policy = policy_for(root, small())
    assert policy.config.urdf == describe_arm("piper").urdf
    assert policy.arm.description.tip_link == describe_arm("piper").tip_link


@pytest.mark.parametrize("batched_reads", [True, False])
def test_degrees_are_refused_with_the_option_that_reads_them(tmp_path, batched_reads):
    root = write_teleop(tmp_path / "data", episodes=1, frames=10)
    for name in ("observation.state", "action"):
        change_column(root, name, lambda values: np.degrees(values, out=values))
    with pytest.raises(ValueError, match=r"observation\.state: joint.*degrees.*--policy\.joint_units=deg"):
        policy_for(root, small(batched_reads=batched_reads))
    assert policy_for(root, small(joint_units="deg")).conditioning.joints.upper.abs().max() < 4


def test_numbers_that_are_not_finite_are_named_in_training(tmp_path):
    root = write_teleop(tmp_path / "data", episodes=2, frames=10)

    def spoil(values):
        values[13, 4] = np.inf

    change_column(root, "action", spoil)
    with pytest.raises(
        ValueError, match=r"action is not finite in 1 frames, first joint5 in episode 1, frame 3"
    ):
        policy_for(root, small())


def test_a_checkpoint_is_not_trained_further_on_numbers_of_another_unit(tmp_path):
    root = write_teleop(tmp_path / "data", episodes=1, frames=10)
    policy_for(root, small()).save_pretrained(tmp_path / "policy")
    change_column(root, "observation.state", lambda values: np.degrees(values, out=values))
    config = small(pretrained_path=tmp_path / "policy", urdf="airbot_play")
    with pytest.raises(ValueError, match=r"--policy\.joint_units=deg"):
        policy_for(root, config)
