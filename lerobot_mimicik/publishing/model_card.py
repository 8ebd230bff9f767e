"""The model card of a MimicIK checkpoint: the robot, the method's settings, the accuracy, how to use it.

Everything in it comes from the checkpoint, from what is known of its training, and from the report of
`mimicik eval`. What is not known is said to be unknown: a card never shows figures of other weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from huggingface_hub import ModelCard, ModelCardData

from lerobot_mimicik.kinematics.urdf import Joint, read_urdf

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_mimicik import MimicIKPolicy

TAGS = ("robotics", "lerobot", "mimicik", "inverse-kinematics")
LOCAL_NAMESPACE = "local/"
"""Datasets of this user are folders of the machine that trained: they have no page to link to."""

_OBJECTIVES = {
    "mip": "minimal iterative policy, two evaluations, t* = {t_star:g}",
    "flow": "flow matching, {flow_steps} Euler steps",
    "regression": "regression, one evaluation",
}
_CONDITIONINGS = {
    "paper": "joints, current pose, target pose",
    "relative": "joints, pose from here to the target",
}


@dataclass(frozen=True)
class TrainingFacts:
    """What a card tells about a training; None where it is not known.

    Attributes:
        dataset: LeRobot repository of the training data.
        episodes: Episodes in that dataset.
        frames: Frames in that dataset.
        fps: Frames a second: the rate at which commands are meant to be asked for.
        batch_size: Samples of one process's step.
        seed: Of the training.
    """

    dataset: str | None = None
    episodes: int | None = None
    frames: int | None = None
    fps: float | None = None
    batch_size: int | None = None
    seed: int | None = None


def model_card(
    policy: MimicIKPolicy,
    repo_id: str | None = None,
    training: TrainingFacts | None = None,
    report: Mapping[str, Any] | None = None,
    license: str | None = None,
    tags: Sequence[str] | None = None,
) -> ModelCard:
    """The card of a policy.

    Its metadata is checked by the Hub when the card is uploaded, as that of every README is.

    Args:
        policy: The policy, with the weights that are published.
        repo_id: Where it is published; a placeholder stands in the commands without it.
        training: What is known of the training.
        report: `report.json` of `mimicik eval` for these very weights; None if there is none.
        license: The publisher's licence for the weights; `unknown` if none is given, because only
            the publisher can grant one.
        tags: Further tags.
    """
    training = training or TrainingFacts()
    known_dataset = training.dataset if _on_hub(training.dataset) else None
    data = ModelCardData(
        license=license or "unknown",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({*TAGS, *(tags or ())}),
        datasets=[known_dataset] if known_dataset else None,
        model_name="mimicik",
    )
    robot = read_urdf(policy.config.urdf).name
    name = repo_id or "USER/NAME"
    sections = [
        f"---\n{data.to_yaml()}\n---\n",
        f"# MimicIK for {robot}\n",
        _summary(policy, robot),
        "## Robot\n",
        _robot(policy, robot),
        "## Accuracy\n",
        _accuracy(name, report),
        "## Use\n",
        _use(policy, name, training.fps or _recorded_rate(report)),
        "## Training\n",
        _training(policy, training),
        "## Limits\n",
        _limits(policy),
        "## Licence and data\n",
        _licence(training, license),
    ]
    return ModelCard("\n".join(sections))


def _summary(policy: MimicIKPolicy, robot: str) -> str:
    return (
        f"Inverse kinematics of the {policy.config.dof}-joint arm *{robot}*, learned from teleoperation: "
        "from the measured joints and a target end-effector pose, the next joint command. A "
        "[LeRobot](https://github.com/huggingface/lerobot) policy of type `mimicik`, after *MimicIK: "
        "Real-Time Generative Inverse Kinematics from Teleoperation with FK Consistency*. The checkpoint "
        "holds the robot's URDF, the normalisation and the processors: nothing else is needed to run it.\n"
    )


def _robot(policy: MimicIKPolicy, robot: str) -> str:
    config = policy.config
    joints = config.arm_description().joints()
    steps = [max(abs(low), abs(high)) for low, high in zip(*_step_bounds(policy), strict=True)]
    facts = [
        ("name in the URDF", f"`{robot}`"),
        ("base link", f"`{config.base_link}`: the frame of every pose"),
        ("tip link", f"`{config.tip_link}`"),
        ("tool in the tip link", _tool(config.tool_offset)),
        ("poses", "x y z in m, then the quaternion x y z w"),
        ("joints in datasets and commands", f"{config.joint_units}, as `{'`, `'.join(config.action_names)}`"
         if config.action_names else config.joint_units),
    ]  # fmt: skip
    table = [
        (
            f"`{joint.name}`",
            joint.type,
            _bound(joint, joint.lower),
            _bound(joint, joint.upper),
            _step(joint, step),
        )
        for joint, step in zip(joints, steps, strict=True)
    ]
    return (
        _table(("", ""), facts)
        + "\n"
        + _table(("joint", "type", "lower limit", "upper limit", "largest step in training"), table)
    )


def _accuracy(name: str, report: Mapping[str, Any] | None) -> str:
    if report is None:
        return (
            "No evaluation is recorded for these weights. To measure them on recorded motion, and to add the "
            "table here:\n\n"
            f"```bash\nmimicik eval --policy.path={name} --dataset.root=DATASET --output=outputs/eval\n```\n\n"
            "```python\n"
            "from lerobot_mimicik.modeling_mimicik import MimicIKPolicy\n\n"
            f'policy = MimicIKPolicy.from_pretrained("{name}")\n'
            f'policy.push_to_hub("{name}", report="outputs/eval")\n'
            "```\n"
        )
    from lerobot_mimicik.evaluation.report import markdown_table

    rows = report["rows"]
    notes = [
        f"- {row['solver']}, {row['mode'].replace('_', ' ')}, {row['dataset']}: "
        f"{row['verdict']}, {row['reason']}."
        for row in rows
        if row.get("reason")
    ]
    notes += [
        f"- Dataset {found['name']}: {found['episodes']} episodes, {found['frames']} frames "
        f"at {found['fps']:g} fps."
        for found in report.get("datasets", ())
    ]
    machine, settings = report.get("machine", {}), report.get("settings", {})
    if machine.get("processor"):
        notes.append(
            f"- Latency: one query at a time on {machine['processor']}, "
            f"{machine.get('torch_threads', '?')} torch threads, device {settings.get('device') or 'cpu'}."
        )
    return (
        "Made by `mimicik eval` with these weights; `report.json` has every figure. *Open loop*: the "
        "recorded joints go in at every frame. *Closed loop*: each command is the next measurement. *hold*: "
        "the arm does not move, which shows what the data alone gives. Rates are in percent of frames.\n\n"
        + markdown_table(rows)
        + ("\n" + "\n".join(notes) + "\n" if notes else "")
    )


def _use(policy: MimicIKPolicy, name: str, fps: float | None) -> str:
    lower, upper = policy.arm.lower.tolist(), policy.arm.upper.tolist()
    pose = [
        round((low + high) / 2, 3) if math.isfinite(high - low) else 0.0
        for low, high in zip(lower, upper, strict=True)
    ]
    rate = f"{fps:g} Hz" if fps else "the rate of the training data"
    return (
        "With the plugin `lerobot_policy_mimicik` installed beside LeRobot, in Python:\n\n"
        "```python\n"
        "import torch\n\n"
        "from lerobot_mimicik.modeling_mimicik import MimicIKPolicy\n\n"
        f'policy = MimicIKPolicy.from_pretrained("{name}")\n'
        "policy.reset()  # whenever an episode starts\n"
        f"q = torch.tensor([{pose}])  # measured joints, rad, shape (1, {len(pose)})\n"
        "target = policy.arm.forward(q)  # the pose asked for: x y z qx qy qz qw, shape (1, 7)\n"
        "target[:, 2] += 0.002\n"
        f"q_cmd = policy.predict_joints(q, target)  # joint command, rad, shape (1, {len(pose)})\n"
        "```\n\n"
        f"Ask once per control step, at {rate}. In LeRobot's terms (`select_action`) the target is the "
        f"observation `{policy.config.target_pose_key}`, and commands come in the dataset's units. On the "
        "command line:\n\n"
        "```bash\n"
        "# How accurate is it?\n"
        f"mimicik eval --policy.path={name} --dataset.root=DATASET --output=outputs/eval\n"
        "# Train it further.\n"
        f"lerobot-train --policy.path={name} --dataset.repo_id=USER/DATASET\n"
        "```\n"
    )


def _training(policy: MimicIKPolicy, training: TrainingFacts) -> str:
    config = policy.config
    parameters = sum(parameter.numel() for parameter in policy.network.parameters())
    fk_step = (
        "an optimiser step of its own" if config.fk_update == "separate" else "one sum with the objective"
    )
    sizes = {
        name: value
        for name, value in (
            ("episodes", training.episodes),
            ("frames", training.frames),
            ("fps", training.fps),
        )
        if value is not None
    }
    rows: list[tuple[str, str]] = [
        ("dataset", _dataset(training.dataset)),
        *(
            (f"{name} of the dataset", f"{value:g}" if name == "fps" else f"{value:,}")
            for name, value in sizes.items()
        ),
        ("target joints", "recorded command" if config.target == "action" else "state one frame later"),
        ("target pose", "recorded" if config.target_pose_recorded else "FK of the target joints"),
        ("network sees", f"{config.n_obs_steps} frames: {_CONDITIONINGS[config.conditioning]}"),
        (
            "objective",
            _OBJECTIVES[config.objective].format(t_star=config.t_star, flow_steps=config.flow_steps),
        ),
        ("FK consistency loss", f"weight {config.fk_weight:g}, in {fk_step}" if config.fk_weight else "none"),
        (
            "network",
            f"{config.n_layers} layers, width {config.d_model}, {config.n_heads} heads, "
            f"{parameters:,} parameters",
        ),
        ("weights used", f"moving average, decay {config.ema_decay:g}"),
        ("steps", f"{int(policy.training_step):,}"),
        *(
            (name, f"{value:,}")
            for name, value in (("batch size", training.batch_size), ("seed", training.seed))
            if value is not None
        ),
        ("learning rate", f"{config.optimizer_lr:g} (AdamW, weight decay {config.optimizer_weight_decay:g})"),
    ]
    return _table(("setting", "value"), rows)


def _limits(policy: MimicIKPolicy) -> str:
    step = (
        "Commands stay within the joint steps seen in training (table above), so a target further away than "
        "one frame's motion is approached over several calls."
        if policy.config.clip_delta
        else "Commands are not held within the joint steps seen in training."
    )
    return (
        "- It knows the motion it was trained on. Far from it, in position, orientation, speed or arm "
        "posture, errors grow; measure on your own motion before you trust it.\n"
        f"- {step} No joint is sent past its limits in the URDF.\n"
        "- It does not know of obstacles, of the arm's own links or of the gripper, which passes through "
        "untouched. Keep the robot's own safety functions on.\n"
        "- It belongs to this arm, this tool frame and the control rate of its data.\n"
        "- Where the dataset was generated, or retargeted from end-effector motion, its joints are synthetic: "
        "accuracy on it is not accuracy on a real arm, with its own lag and noise.\n"
    )


def _licence(training: TrainingFacts, license: str | None) -> str:
    granted = (
        f"The weights are published under `{license}`. "
        if license
        else "Nobody has stated a licence for these weights (`--policy.license=` sets it). "
    )
    source = f" ({_dataset(training.dataset)})" if training.dataset else ""
    return (
        granted
        + f"They are made from the training data{source}, whose own terms may bind whoever uses or shares "
        "them; this card does not know these terms. The data is not part of this repository; the URDF is, "
        "inside `config.json`. The code is Apache-2.0.\n"
    )


def _recorded_rate(report: Mapping[str, Any] | None) -> float | None:
    """Frames a second of the evaluated datasets, if they agree."""
    rates = {found["fps"] for found in (report or {}).get("datasets", ())}
    return rates.pop() if len(rates) == 1 else None


def _step_bounds(policy: MimicIKPolicy) -> tuple[list[float], list[float]]:
    """Smallest and largest joint difference per frame seen in training, rad or m."""
    return policy.delta.lower.tolist(), policy.delta.upper.tolist()


def _tool(offset: Sequence[float]) -> str:
    if not offset:
        return "none: the tip link's frame"
    xyz = f"xyz = {' '.join(f'{value:g}' for value in offset[:3])} m"
    return xyz if len(offset) == 3 else f"{xyz}, rpy = {' '.join(f'{value:g}' for value in offset[3:])} rad"


def _bound(joint: Joint, value: float) -> str:
    return _amount(joint, value) if math.isfinite(value) else "none"


def _amount(joint: Joint, value: float) -> str:
    return f"{value:.3f} m" if joint.type == "prismatic" else f"{value:.3f} rad ({math.degrees(value):.1f}°)"


def _step(joint: Joint, value: float) -> str:
    return f"{value:.4f} {'m' if joint.type == 'prismatic' else 'rad'}"


def _on_hub(dataset: str | None) -> bool:
    return dataset is not None and dataset.count("/") == 1 and not dataset.startswith(LOCAL_NAMESPACE)


def _dataset(dataset: str | None) -> str:
    if dataset is None:
        return "unknown"
    if _on_hub(dataset):
        return f"[{dataset}](https://huggingface.co/datasets/{dataset})"
    return f"`{dataset}`, not on the Hub"


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
