"""Checkpoints of end-effector policies made ready for robots, with the inverse kinematics inside or without.

    preprocessor   rename, batch, device, [JointsToEEState], normalise     (joints in, poses to the policy)
    postprocessor  unnormalise, device, [EEActionToJoints]                 (poses from the policy, joints out)

For robots in end-effector space only the preprocessor of a policy without cameras changes: it is given its state
as environment state too.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_mimicik.checkpoints import find_checkpoint, read_config
from lerobot_mimicik.kinematics.poses import PoseFormat
from lerobot_mimicik.weights import CheckpointError, check_tensors
from robot_adapters.adapter import AdapterSettings, MimicIKAdapter

_STATE, _ENVIRONMENT = "observation.state", "observation.environment_state"
_COPIED = ("*.safetensors", "*.json", "*.md", "*.yaml")


def wrap_checkpoint(
    policy_path: str,
    ik_path: str | None,
    output: str | Path,
    *,
    rotation: PoseFormat = PoseFormat.QUATERNION,
    tool: Sequence[float] = (),
    joint_units: str = "rad",
    settings: AdapterSettings | None = None,
) -> Path:
    """Write a copy of an end-effector policy's checkpoint that takes and gives joints, or poses.

    Args:
        policy_path: The policy's checkpoint: a folder, a training run's output, or a Hub repository.
        ik_path: A MimicIK checkpoint; None: the robot takes poses, as `airbot_play_ee` does.
        output: Folder to write; must not exist or be empty.
        rotation: Format of the policy's poses, in state and action; a gripper may follow.
        tool: The policy's tool in the arm's tool frame, T_tool_policytool (7,); empty: the same.
        joint_units: `rad` or `deg`, of the robot.
        settings: Of the adapter.

    Returns:
        The folder.

    Raises:
        FileExistsError: `output` holds something.
        FileNotFoundError, TypeError: A checkpoint is missing, or not of the right kind.
        CheckpointError: A checkpoint is damaged.
        ValueError: The policy's state or action is no pose in that format, or a difference of poses.
    """
    from lerobot.processor import (
        NormalizerProcessorStep,
        PolicyProcessorPipeline,
        ProcessorStep,
        RelativeActionsProcessorStep,
    )

    from lerobot_mimicik.solvers.mimicik import MimicIKSolver
    from robot_adapters.processor_steps import EEActionToJoints, JointsToEEState, StateAsEnvironment

    output = Path(output)
    check_output(output)
    source = _local_folder(find_checkpoint(policy_path))
    config, preprocessor, postprocessor = _read_policy(source)
    state_keys = _check_features(config, rotation)
    before: ProcessorStep = StateAsEnvironment()
    after: list[ProcessorStep] = []
    joint_names: Sequence[str] = ()
    if ik_path is not None:
        adapter = MimicIKAdapter.from_pretrained(ik_path)
        if not isinstance(adapter.solver, MimicIKSolver):
            raise ValueError(
                f"{ik_path} is a checkpoint of foresight, which a wrapped policy does not take: expected one of MimicIK"
            )
        policy = adapter.solver.policy
        joint_names = adapter.joint_names
        shared: dict[str, Any] = {
            "joint_units": joint_units,
            "rotation": rotation.value,
            "tool": list(tool),
        }
        before = JointsToEEState(arm=adapter.description.to_json(), state_keys=state_keys, **shared)
        # The settings as asked for: the checkpoint's training ranges are found again on loading.
        solve = EEActionToJoints(
            policy=_plain_config(policy.config), settings=asdict(settings or AdapterSettings()), **shared
        )
        solve.load_state_dict(policy.state_dict())
        after = [solve]
    elif _ENVIRONMENT not in state_keys:
        raise ValueError("without ik.path there is nothing to do: the policy needs no environment state")
    steps = list(preprocessor.steps)
    relative = (step for step in steps if isinstance(step, RelativeActionsProcessorStep))
    if ik_path is not None and any(step.enabled for step in relative):
        raise ValueError(
            f"the policy ({config.type}) answers with differences to its state (use_relative_actions); expected "
            "absolute poses"
        )
    # The policy's own step for relative actions, which is off, comes after: LeRobot connects the first of them.
    own = (NormalizerProcessorStep, RelativeActionsProcessorStep)
    place = next((i for i, step in enumerate(steps) if isinstance(step, own)), len(steps))
    steps.insert(place, before)
    output.mkdir(parents=True, exist_ok=True)
    for pattern in _COPIED:
        for path in source.glob(pattern):
            if not path.name.startswith(("policy_preprocessor", "policy_postprocessor")):
                shutil.copy2(path, output / path.name)
    PolicyProcessorPipeline(steps=steps, name=preprocessor.name).save_pretrained(output)
    steps = [*postprocessor.steps, *after]
    PolicyProcessorPipeline(steps=steps, name=postprocessor.name).save_pretrained(output)
    if joint_names:
        _rename_actions(output / "config.json", joint_names)
    return output


def check_output(output: str | Path) -> None:
    """See that a checkpoint can be written to a folder; FileExistsError if there is something."""
    folder = Path(output)
    if folder.is_file() or (folder.exists() and any(folder.iterdir())):
        raise FileExistsError(f"{output} exists already; choose another folder")


def _read_policy(folder: Path) -> tuple[Any, Any, Any]:
    """A policy's configuration and its two pipelines, its weights looked at but not read.

    Raises:
        CheckpointError: Something is damaged or missing; names the file or folder, and the reason.
    """
    from lerobot.policies.factory import make_pre_post_processors
    from safetensors import SafetensorError

    config = read_config(str(folder))
    tensors = list(folder.glob("*.safetensors"))
    if all(file.name.startswith("policy_p") for file in tensors):
        raise CheckpointError(f"{folder} has no weights: expected model.safetensors")
    for file in tensors:
        check_tensors(file)
    try:
        return config, *make_pre_post_processors(config, pretrained_path=str(folder))
    except (
        SafetensorError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        ImportError,
        OSError,
    ) as error:
        # LeRobot prints a step's whole configuration before the reason.
        reason = str(error).rpartition(". Error: ")[2]
        raise CheckpointError(f"the processors of {folder} cannot be loaded: {reason}") from error


def _local_folder(path: str) -> Path:
    if Path(path).is_dir():
        return Path(path)
    from huggingface_hub import snapshot_download

    return Path(snapshot_download(path))


def _check_features(config: Any, rotation: PoseFormat) -> list[str]:
    """The keys under which the policy sees its state; ValueError if its numbers are no pose."""
    widths = {key: feature.shape[-1] for key, feature in (config.input_features or {}).items()}
    keys = [key for key in (_STATE, _ENVIRONMENT) if key in widths]
    outputs = config.output_features or {}
    action = outputs["action"].shape[-1] if "action" in outputs else None
    fitting = (rotation.width, rotation.width + 1)
    if not keys or action not in fitting or any(widths[key] not in fitting for key in keys):
        raise ValueError(
            f"the policy ({config.type}) has inputs {widths} and an action of {action or 'no'} numbers; expected a pose "
            f"of {rotation.width} ({' '.join(rotation.names)}), with or without a gripper, as "
            f"{_STATE} or {_ENVIRONMENT} and as action"
        )
    return keys


def _plain_config(config: Any) -> dict[str, Any]:
    """A MimicIK configuration as keyword arguments that survive JSON, without what only training needs."""
    import dataclasses

    left_out = {"input_features", "output_features", "normalization_mapping", "pretrained_path"}
    plain = {
        each.name: getattr(config, each.name)
        for each in dataclasses.fields(config)
        if each.init and each.name not in left_out
    }
    kept = {name: value for name, value in plain.items() if _is_plain(value)}
    return kept | {"device": "cpu", "push_to_hub": False, "repo_id": None}


def _is_plain(value: Any) -> bool:
    try:
        json.dumps(value)
    except TypeError:
        return False
    return True


def _rename_actions(path: Path, joint_names: Sequence[str]) -> None:
    """A policy that names its actions names joints now."""
    config = json.loads(path.read_text())
    names = config.get("action_feature_names")
    if names:
        grippers = [name.removeprefix("ee.") for name in names if "gripper" in name]
        config["action_feature_names"] = [f"{name}.pos" for name in joint_names] + grippers
        path.write_text(json.dumps(config, indent=4) + "\n")
