"""What the network is told: the normalised observation of a frame.

- `paper`: q, current pose, target pose (20 numbers for six joints).
- `relative`: q, current pose, and the target relative to it: translation difference in the base frame
  and rotation vector of R_tgt R_curr^T (19 numbers), which spares the network the difference of two
  nearly equal poses. A target further away than training ever asked for becomes a step towards it.

Joints, positions and relative poses go to [-1, 1] by min-max, quaternions stay as they are.
"""

import torch
from torch import Tensor, nn

from lerobot_mimicik.kinematics.rotations import relative_pose
from lerobot_mimicik.normalisation import MinMax

_FAR = 3.0  # how many times further than in training a target is from which on the step is shortest
_SURE = (
    0.5  # fraction of the largest step in training that this shortest step is: such steps are common there
)
_MOVED = 1e-6  # m or rad: a dimension that training never used limits nothing


class Conditioning(nn.Module):
    """The paper's observation o = [q_curr, x_curr, x_tgt]."""

    def __init__(self, dof: int):
        super().__init__()
        self.joints = MinMax(dof)
        self.position = MinMax(3)

    @property
    def dim(self) -> int:
        """Numbers in a frame's observation."""
        return len(self.joints.lower) + 14

    def quantities(self, q: Tensor, current: Tensor, target: Tensor) -> dict[str, Tensor]:
        """What each normaliser is fitted on, by its attribute's name; shapes (N, ...)."""
        return {"joints": q, "position": torch.cat([current[..., :3], target[..., :3]])}

    def forward(self, q: Tensor, current: Tensor, target: Tensor) -> Tensor:
        """Normalised observation, shape (*, dim).

        Args:
            q: Joints, rad, shape (*, dof).
            current: T_base_tool measured, shape (*, 7).
            target: T_base_tool asked for, shape (*, 7).
        """
        return torch.cat([self.joints.normalise(q), self._pose(current), self._pose(target)], dim=-1)

    def _pose(self, pose: Tensor) -> Tensor:
        return torch.cat([self.position.normalise(pose[..., :3]), pose[..., 3:]], dim=-1)


class RelativeConditioning(Conditioning):
    """The target as seen from the current pose, no further away than any in training."""

    def __init__(self, dof: int):
        super().__init__(dof)
        self.relative = MinMax(6)

    @property
    def dim(self) -> int:
        return len(self.joints.lower) + 13

    def quantities(self, q: Tensor, current: Tensor, target: Tensor) -> dict[str, Tensor]:
        return {**super().quantities(q, current, target), "relative": relative_pose(current, target)}

    def forward(self, q: Tensor, current: Tensor, target: Tensor) -> Tensor:
        relative = self.relative.normalise(self._within_reach(relative_pose(current, target)))
        return torch.cat([self.joints.normalise(q), self._pose(current), relative], dim=-1)

    def _within_reach(self, relative: Tensor) -> Tensor:
        """The same direction, no further than training asked for, shape (*, 6).

        Behind a target that it cannot follow at once the network would else be asked for what it never saw, and
        would not come back. Steps of the largest size are rare in training: from a target `_FAR` times too far on
        the step is the fraction `_SURE` of the largest.
        """
        largest = torch.where(relative > 0, self.relative.upper, -self.relative.lower)
        times = (
            (relative.abs() / largest).where(largest > _MOVED, 0.0).amax(dim=-1, keepdim=True).clamp(min=1.0)
        )
        caution = (1 - _SURE) * ((times - 1) / (_FAR - 1)).clamp(max=1.0)
        return relative * (1 - caution) / times


CONDITIONINGS = {"paper": Conditioning, "relative": RelativeConditioning}
