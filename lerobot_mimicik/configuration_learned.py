"""Configuration shared by every learned policy here: the arm, the dataset's columns, loss and training."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_mimicik.columns import flat_names, joint_columns
from lerobot_mimicik.configuration_reasons import check_types, reasons_for_users
from lerobot_mimicik.kinematics.arms import ArmDescription, arm_of_dataset, describe_arm
from lerobot_mimicik.kinematics.plausibility import why_not_same_arm

_logger = logging.getLogger(__name__)
_DEFAULT_ARM = "airbot_play"

MAX_WEIGHTS = 500_000_000
"""Of a network; the paper's has 16 million. A configuration that asks for more is refused before it is built."""
MAX_OBS_STEPS = 100
"""Observation frames, 5 s at 20 Hz; two are used."""
MAX_JOINTS = 32
"""Joints of one arm; a configuration with more is no arm's."""

_CHOICES = {
    "joint_units": ("rad", "deg"),
    "target": ("action", "next_state"),
    "conditioning": ("paper", "relative"),
    "fk_update": ("separate", "joint"),
}


@dataclass
class LearnedIKConfig(PreTrainedConfig):
    """Everything a checkpoint needs to be used again, the robot's URDF included, but for its network's sizes.

    The defaults are the paper's, except `conditioning`, where the better one measured is the default.
    """

    # Observation frames T_o the network sees: the current one and those before it.
    n_obs_steps: int = 2
    # The policy normalises by itself: the statistics of delta q and of poses are not those of a dataset column.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(
            ("STATE", "ENV", "ACTION", "VISUAL"), NormalizationMode.IDENTITY
        )
    )

    # --- The arm. ---
    # A shipped arm's name (`mimicik arms`), a path to a URDF, or the URDF itself; stored as text. Empty: the
    # arm that the training dataset names in its meta/arm.json, airbot_play where it names none.
    urdf: str = ""
    base_link: str | None = None
    tip_link: str | None = None
    # Joints from base to tip unless given in another order.
    joint_names: list[str] | None = None
    # Tool frame in the tip link: xyz in metres, or xyz and rpy in radians. Empty: the tip link itself.
    tool_offset: list[float] = field(default_factory=list)
    # Units of joints in the dataset and in the commands.
    joint_units: str = "rad"

    # --- The dataset. ---
    # Where the target joints are read: the recorded command, or the state one frame later.
    target: str = "action"
    # Pose columns (x y z qx qy qz qw, base frame); FK takes the place of one that the dataset does not have.
    current_pose_key: str | None = "observation.ee_pose"
    target_pose_key: str = "observation.ee_target"
    # Does the dataset record the target pose? Without it, training uses FK of the target joints.
    target_pose_recorded: bool = True
    # Names of the joints in the state and in the action, in joint order, or their positions ([0,1,2,...]); by
    # default they are found by the arm's joint names, and the action's like the state's.
    state_joint_names: list[str] | None = None
    action_joint_names: list[str] | None = None
    # Found from the dataset: positions of the joints, and the commands' element names.
    state_joint_columns: list[int] | None = None
    action_joint_columns: list[int] | None = None
    action_names: list[str] | None = None

    # --- The method. ---
    conditioning: str = "relative"
    # Weight lambda of the FK consistency loss; 0 switches it off.
    fk_weight: float = 0.1
    # The FK loss is |dp / fk_position_scale|^2 + fk_rotation_weight * d_R: dp in millimetres by default, and a
    # rotation counts as the motion of a point 10 cm away, (100 mm/rad)^2. In metres the FK gradient would be
    # four orders of magnitude below the objective's and, sharing its AdamW, without effect.
    fk_position_scale: float = 0.001
    fk_rotation_weight: float = 1e4
    # A pass of its own with its own optimiser step (the paper), or one sum and one step.
    fk_update: str = "separate"
    # Keep every command within the joint steps seen in training: the policy cannot jump further than its data.
    clip_delta: bool = True
    ema_decay: float = 0.995
    # Read whole batches at once during training (same samples; off: LeRobot's frame-by-frame reading).
    batched_reads: bool = True

    # --- Training. ---
    optimizer_lr: float = 1e-4
    optimizer_weight_decay: float = 1e-5
    grad_clip_norm: float = 10.0

    def __post_init__(self) -> None:
        with reasons_for_users():
            super().__post_init__()
            self.urdf = str(self.urdf)  # a path may be given as one
            check_types(self)
            self.check()
            self._store_arm()

    def check(self) -> None:
        """Refuses values that cannot work; a subclass adds those of its own fields.

        Raises:
            ValueError: Names the field, its value and what was expected.
        """
        for name, choices in _CHOICES.items():
            self.check_choice(name, choices)
        self.check_sizes(n_obs_steps=MAX_OBS_STEPS)
        for name in ("fk_weight", "fk_rotation_weight", "grad_clip_norm", "optimizer_weight_decay"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}={getattr(self, name)}: expected zero or more")
        for name in ("fk_position_scale", "optimizer_lr"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}={getattr(self, name)}: expected more than zero")
        self.check_share("ema_decay")

    def check_choice(self, name: str, choices: tuple[str, ...]) -> None:
        """Raises ValueError unless the field's value is one of `choices`."""
        if getattr(self, name) not in choices:
            raise ValueError(f"{name}={getattr(self, name)!r}: expected one of {', '.join(choices)}")

    def check_sizes(self, **largest: int) -> None:
        """Raises ValueError unless these fields, counts and sizes, lie between one and the largest given."""
        for name, most in largest.items():
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name}={getattr(self, name)}: expected 1 to {most}")

    def check_share(self, name: str) -> None:
        """Raises ValueError unless the field's value lies in [0, 1)."""
        if not 0 <= getattr(self, name) < 1:
            raise ValueError(f"{name}={getattr(self, name)}: expected in [0, 1)")

    def _store_arm(self) -> None:
        """Replaces a name or path by the URDF's text, so that the configuration needs no other file."""
        self._no_joints = ""
        self._asked: dict[str, Any] = {
            "base_link": self.base_link,
            "tip_link": self.tip_link,
            "joint_names": self.joint_names,
            "tool_offset": self.tool_offset or None,
        }
        self._arm_is_asked = bool(self.urdf)
        self._take_arm(describe_arm(self.urdf or _DEFAULT_ARM, **self._asked))

    def _take_arm(self, arm: ArmDescription) -> None:
        if len(arm.joint_names) > MAX_JOINTS:
            raise ValueError(f"the arm has {len(arm.joint_names)} joints: expected at most {MAX_JOINTS}")
        self.urdf, self.base_link, self.tip_link = arm.urdf, arm.base_link, arm.tip_link
        self.joint_names, self.tool_offset = list(arm.joint_names), list(arm.tool_offset)

    def use_dataset(self, root: str | Path, features: dict[str, dict[str, Any]]) -> None:
        """Takes the arm of the training dataset, unless another one was asked for, and finds its columns.

        Raises:
            ValueError: If a column is missing, or the joints are not the arm's; the message lists what exists.
        """
        own = arm_of_dataset(root)
        if own is not None and not self._arm_is_asked:
            asked = {name: value or getattr(own, name) for name, value in self._asked.items()}
            self._take_arm(describe_arm(own.urdf, **asked))
        elif own is not None:
            reason = why_not_same_arm(self.arm_description(), own)
            if reason is not None:
                _logger.warning("%s was made for another arm than --policy.urdf: %s", root, reason)
        self._arm_is_asked = True  # now it is known, and joints that are not its own are an error
        self.set_dataset_feature_metadata(features)

    def arm_description(self) -> ArmDescription:
        """The arm this policy moves."""
        return describe_arm(
            self.urdf,
            base_link=self.base_link,
            tip_link=self.tip_link,
            joint_names=self.joint_names,
            tool_offset=self.tool_offset or None,
        )

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.joint_names or ())

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Finds the arm's columns in a dataset; LeRobot calls this before it builds the policy.

        Raises:
            ValueError: If a needed column is missing or does not fit the arm; the message lists what exists.
        """
        if OBS_STATE not in features:
            raise ValueError(
                f"the dataset has no {OBS_STATE!r} column (measured joints); it has {sorted(features)}"
            )
        if self.target == "action" and ACTION not in features:
            raise ValueError(
                f"the dataset has no {ACTION!r} column; it has {sorted(features)}. "
                "Use --policy.target=next_state for recordings without commands"
            )
        commands = ACTION if self.target == "action" else OBS_STATE
        try:
            self._find_joints(features, commands)
        except ValueError as error:
            if self._arm_is_asked:
                raise
            self._no_joints = str(error)  # LeRobot tells only the policy which dataset this is: `use_dataset`
            return
        self._no_joints = ""
        self.action_names = flat_names(features[commands].get("names"))
        if self.current_pose_key not in features:
            self.current_pose_key = None
        self.target_pose_recorded = self.target_pose_key in features
        # Cameras and other columns are none of this policy's business; a target pose always is.
        width = int(features[OBS_STATE]["shape"][-1])
        self.input_features = {OBS_STATE: PolicyFeature(FeatureType.STATE, (width,))}
        for key in filter(None, (self.current_pose_key, self.target_pose_key)):
            width = int(features[key]["shape"][-1]) if key in features else 7
            if width < 7:
                raise ValueError(f"{key} has {width} elements; expected a pose x y z qx qy qz qw")
            self.input_features[key] = PolicyFeature(FeatureType.STATE, (width,))
        width = int(features[commands]["shape"][-1])
        self.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (width,))}

    def _find_joints(self, features: dict[str, dict[str, Any]], commands: str) -> None:
        """Finds the joints among the elements of the state and of the commands."""
        state_names = self.state_joint_names
        self.state_joint_columns = self._columns(features, OBS_STATE, state_names, "state_joint_names")
        action_names = self.action_joint_names if commands == ACTION else state_names
        try:
            self.action_joint_columns = self._columns(features, commands, action_names, "action_joint_names")
        except ValueError:
            if action_names is not None or state_names is None:
                raise
            # Named for the state only: commands are mostly called the same.
            self.action_joint_columns = self._columns(features, commands, state_names, "action_joint_names")

    def _columns(
        self, features: dict[str, dict[str, Any]], key: str, requested: list[str] | None, option: str
    ) -> list[int]:
        feature = features[key]
        return joint_columns(
            key,
            flat_names(feature.get("names")),
            int(feature["shape"][-1]),
            self.joint_names or [],
            requested,
            f"--policy.{option}",
        )

    def validate_features(self) -> None:
        """Checks what cannot be known before a dataset or a robot is.

        Raises:
            ValueError: If the joints have no place in the state.
        """
        if self._no_joints:
            raise ValueError(self._no_joints)
        state = (self.input_features or {}).get(OBS_STATE)
        if state is not None and state.shape[-1] < self.dof:
            raise ValueError(f"{OBS_STATE} has {state.shape[-1]} elements, the arm has {self.dof} joints")

    @property
    def observation_delta_indices(self) -> list[int]:
        """Frames read for each sample: the history, and the next frame where that is the target."""
        history = list(range(1 - self.n_obs_steps, 1))
        return [*history, 1] if self.target == "next_state" else history

    @property
    def action_delta_indices(self) -> list[int]:
        """Commands read for each sample: those of the observed frames."""
        return list(range(1 - self.n_obs_steps, 1))

    @property
    def reward_delta_indices(self) -> None:
        """No reward is read."""
        return None

    @property
    def drop_n_last_frames(self) -> int:
        """The last frame of an episode has no next state to learn from."""
        return 1 if self.target == "next_state" else 0

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW as in the paper's appendix C."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.grad_clip_norm,
        )

    def get_scheduler_preset(self) -> LRSchedulerConfig:
        """Cosine annealing over the whole run, without warm-up."""
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=0)
