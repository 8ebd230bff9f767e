"""An adapter around a policy that answers in chunks of torch tensors, as vision-language-action models do.

Run it with `uv run python examples/wrap_policy.py`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lerobot_mimicik.kinematics.poses import PolicyFrames, PoseFormat, PoseReference
from robot_adapters.adapter import IKStatus, MimicIKAdapter

CHUNK = 16


class ForwardPolicy:
    """Stands for a policy: the tool goes 2 mm forward a frame and keeps its orientation, and the gripper opens.

    It has the interface of LeRobot's policies, and sees the end-effector pose as its state.
    """

    def predict_action_chunk(self, batch: dict[str, Tensor]) -> Tensor:
        """Chunks (B, T, 10): poses seen from the present one, rotation as 6 numbers, and the gripper's opening [m]."""
        rows = len(batch["observation.state"])
        chunk = torch.zeros(rows, CHUNK, 10)
        chunk[..., 0] = 0.002 * torch.arange(1, CHUNK + 1)
        chunk[..., 3] = chunk[..., 7] = 1.0  # the first two columns of the identity
        chunk[..., 9] = 0.05
        return chunk


def main(frames: int = 2 * CHUNK) -> list[IKStatus]:
    """Follow the policy for so many frames; what became of each target."""
    # With a checkpoint: MimicIKAdapter.from_pretrained("outputs/run").
    adapter = MimicIKAdapter.for_arm("airbot_play")
    policy = adapter.wrap(
        ForwardPolicy(), PolicyFrames(form=PoseFormat.ROTATION_6D, reference=PoseReference.TOOL)
    )
    state = np.array([*adapter.description.home, 0.0])  # six joints [rad] and the gripper's opening [m]
    policy.reset()
    statuses = []
    for _ in range(frames):
        state = policy.select_action({"observation.state": torch.as_tensor(state)})  # a robot would move here
        statuses.append(policy.result.status)
    print(
        f"{policy.result.status}, {policy.result.position_error * 1e3:.3f} mm off, opening {state[6]:.3f} m"
    )
    return statuses


if __name__ == "__main__":
    main()
