"""Guidance with foresight, what `MimicIKAdapter.from_pretrained` of an arm's name runs, and its network alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_mimicik.foresight.features import Features
from lerobot_mimicik.foresight.foresight import Foresight
from lerobot_mimicik.foresight.network import FilterNetwork
from lerobot_mimicik.foresight.weights import ForesightWeights, shipped
from lerobot_mimicik.guidance.descent import keep_bounds
from lerobot_mimicik.guidance.guided import Guidance
from lerobot_mimicik.guidance.model import arm_model
from lerobot_mimicik.guidance.settings import GuidanceSettings
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.plausibility import why_not_same_arm
from lerobot_mimicik.solvers.availability import SolverUnavailable
from lerobot_mimicik.solvers.base import Array, IKSolver, register_solver
from lerobot_mimicik.solvers.guided import GuidedSolver

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


@register_solver("foresight")
class ForesightSolver(GuidedSolver):
    """Guidance whose target a learned prior makes steady."""

    name = "foresight"
    configuration = (
        "This project's guidance; a network of this project moves a trembling target by at most 1.2 mm and 0.6 degrees "
        "towards where it foresees the hand; what MimicIKAdapter.from_pretrained('airbot_play') runs"
    )

    def __init__(
        self, arm: SerialArm, policy: LearnedIKPolicy | str | Path | None = None, **settings: Any
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            policy: A loaded foresight policy, a checkpoint's folder, or a shipped arm's name; None finds the weights in
                the package.
            settings: Of `GuidanceSettings`; `device` is taken and not needed.

        Raises:
            SolverUnavailable: If the package has no weights for this arm.
        """
        settings.pop("device", None)
        super().__init__(arm)
        self._guidance = Guidance(
            arm_model(arm.description),
            GuidanceSettings(**settings),
            foresight=_foresight(arm, policy),
        )


@register_solver("foresight_alone")
class ForesightAloneSolver(IKSolver):
    """The network's own steps, within limits and step bound."""

    name = "foresight_alone"
    configuration = "The network of the row foresight alone, within limits and 0.095 rad a frame"

    def __init__(
        self,
        arm: SerialArm,
        policy: LearnedIKPolicy | str | Path | None = None,
        device: str | None = None,
        max_step: float = GuidanceSettings.max_step,
    ) -> None:
        """As `ForesightSolver`."""
        self._foresight = _foresight(arm, policy)
        self._model, self._step = arm_model(arm.description), np.full(arm.dof, max_step)

    def reset(self, q: Array) -> None:
        """The arm is at rest at `q` (dof,)."""
        self._foresight.reset(q)

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,)."""
        command = self._foresight(q_curr, target_pose)[None]
        keep_bounds(command, q_curr, self._model.lower, self._model.upper, self._step)
        return command[0]


def _foresight(arm: SerialArm, policy: LearnedIKPolicy | str | Path | None) -> Foresight:
    if policy is None:
        for name in shipped():
            if why_not_same_arm(arm.description, describe_arm(name)) is None:
                return Foresight.load(name, arm.description)
        raise SolverUnavailable(
            f"the package has no foresight weights for this arm, only for {', '.join(shipped())}; a checkpoint "
            "trained by configs/foresight.json is given as the policy"
        )
    if isinstance(policy, str | Path):
        return Foresight.load(policy, arm.description)
    config: Any = policy.config
    tensors = {name: value.cpu().numpy() for name, value in policy.average.network.state_dict().items()}
    network = FilterNetwork(tensors, config.dof, config.objective, config.t_star)
    features = Features(arm.description, config.n_obs_steps)
    return Foresight(ForesightWeights(arm.description, features, network))
