"""The model card of a MimicIK checkpoint: the robot, the method's settings, the accuracy, how to use it.

Everything in it comes from the checkpoint, from what is known of its training, and from the report of
`mimicik eval`. What is not known is said to be unknown: a card never shows figures of other weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from huggingface_hub import ModelCard, ModelCardData

from lerobot_mimicik.kinematics.urdf import Joint, read_urdf
from lerobot_mimicik.publishing.training_facts import TrainingFacts

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

TAGS = ("robotics", "lerobot", "mimicik", "inverse-kinematics")
KEPT_BELOW = "<!-- What stands below this line is kept when the checkpoint is pushed again. -->"
LOCAL_NAMESPACE = "local/"
"""Datasets of this user are folders of the machine that trained: they have no page to link to."""

_FORESIGHT = "mimicik_foresight"
_NAMES = {"mimicik": "MimicIK", _FORESIGHT: "MimicIK foresight"}
_OBJECTIVES = {
    "mip": "minimal iterative policy, two evaluations, t* = {t_star:g}",
    "flow": "flow matching, {flow_steps} Euler steps",
    "regression": "regression, one evaluation",
}
_CONDITIONINGS = {
    "paper": "joints, current pose, target pose",
    "relative": "joints, pose from here to the target",
}


def model_card(
    policy: LearnedIKPolicy,
    repo_id: str | None = None,
    training: TrainingFacts | None = None,
    report: Mapping[str, Any] | None = None,
    picture: str | None = None,
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
        picture: Caption of `singularity.gif` beside the card; None if there is no such picture.
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
        model_name=policy.config.type,
    )
    robot = read_urdf(policy.config.urdf).name
    name = repo_id or "USER/NAME"
    sections = [
        f"---\n{data.to_yaml()}\n---\n",
        f"# {_NAMES.get(policy.config.type, policy.config.type)} for {robot}\n",
        _summary(policy, robot),
        "## Use\n",
        _use(policy, name, training.fps or _recorded_rate(report)),
        *(
            []
            if picture is None
            else [f"![{robot} led through a singularity](singularity.gif)\n\n{picture}\n"]
        ),
        "## Accuracy\n",
        _accuracy(policy, name, report),
        "## Data\n",
        _data(training),
        "## Robot\n",
        _robot(policy, robot),
        "## Training\n",
        _training(policy, training),
        "## Limits\n",
        _limits(policy),
        "## Licence and data\n",
        _licence(training, license),
        f"{KEPT_BELOW}\n",
    ]
    return ModelCard("\n".join(sections))


def _summary(policy: LearnedIKPolicy, robot: str) -> str:
    what = (
        "A hand that trembles asks for poses that it does not mean: from its last targets this network tells what the hand "
        "means, and moves the target of the guided solver by at most the radius that its user allows."
        if policy.config.type == _FORESIGHT
        else "From the measured joints and a target end-effector pose, the next joint command."
    )
    return (
        f"Inverse kinematics of the {policy.config.dof}-joint arm *{robot}*, learned from teleoperation. {what} A "
        f"[LeRobot](https://github.com/huggingface/lerobot) policy of type `{policy.config.type}`, after *MimicIK: "
        "Real-Time Generative Inverse Kinematics from Teleoperation with FK Consistency*. The checkpoint "
        "holds the robot's URDF, the normalisation and the processors: nothing else is needed to run it.\n"
    )


def _robot(policy: LearnedIKPolicy, robot: str) -> str:
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


def _accuracy(policy: LearnedIKPolicy, name: str, report: Mapping[str, Any] | None) -> str:
    if report is None:
        return (
            "No evaluation is recorded for these weights. To measure them on recorded motion, and to add the "
            "table here:\n\n"
            f"```bash\nmimicik eval --policy.path={name} --dataset.root=DATASET --output=outputs/eval\n```\n\n"
            "```python\n"
            "from lerobot_mimicik.checkpoints import load_policy\n\n"
            f'policy = load_policy("{name}")\n'
            f'policy.push_to_hub("{name}", report="outputs/eval")\n'
            "```\n"
        )
    from lerobot_mimicik.evaluation.short_table import legend, markdown, measured

    rows, missing = measured(report["rows"])
    notes = [
        f"- {row['solver']}, {row['mode'].replace('_', ' ')}, {row['dataset']}: "
        f"{row['verdict']}, {row['reason']}."
        for row in rows
        if row.get("reason")
    ]
    notes += [f"- {name} was not measured: {reason}" for name, reason in missing.items()]
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
        "the arm does not move, which shows what the data alone gives.\n\n"
        + markdown(rows)
        + f"\n{legend()}\n"
        + ("\n" + "\n".join(notes) + "\n" if notes else "")
    )


def _use(policy: LearnedIKPolicy, name: str, fps: float | None) -> str:
    lower, upper = policy.arm.lower.tolist(), policy.arm.upper.tolist()
    pose = [
        round((low + high) / 2, 3) if math.isfinite(high - low) else 0.0
        for low, high in zip(lower, upper, strict=True)
    ]
    rate = f"{fps:g} Hz" if fps else "the rate of the training data"
    alone = "" if policy.config.type == _FORESIGHT else _network_alone(policy, name, pose)
    return (
        "Install the plugin `lerobot_policy_mimicik` beside LeRobot 0.6 (Python 3.12): `pip install -e .` in a checkout of "
        "it. Then, in Python, behind the solver that keeps limits and step bounds and says whether the target is met:\n\n"
        "```python\n"
        "import numpy as np\n\n"
        "from robot_adapters.adapter import MimicIKAdapter\n\n"
        f'adapter = MimicIKAdapter.from_pretrained("{name}")\n'
        f"q = np.array({pose})  # measured joints, rad\n"
        "target = adapter.forward(q)  # the pose asked for: x y z qx qy qz qw\n"
        "target[2] += 0.002\n"
        "result = adapter.solve(q, target)\n"
        "print(result.status, result.q, result.position_error)  # joints to command, rad; error, m\n"
        "```\n\n"
        f"Ask once per control step, at {rate}. {alone}On the command line:\n\n"
        "```bash\n"
        "# How accurate is it?\n"
        f"mimicik eval --policy.path={name} --dataset.root=DATASET --output=outputs/eval\n"
        "# See it.\n"
        f"mimicik play --policy.path={name}\n"
        "# Train it further.\n"
        f"lerobot-train --policy.path={name} --dataset.repo_id=USER/DATASET\n"
        "```\n"
    )


def _network_alone(policy: LearnedIKPolicy, name: str, pose: list[float]) -> str:
    kind = type(policy)
    return (
        "The network alone:\n\n"
        "```python\n"
        "import torch\n\n"
        f"from {kind.__module__} import {kind.__name__}\n\n"
        f'policy = {kind.__name__}.from_pretrained("{name}")\n'
        "policy.reset()  # whenever an episode starts\n"
        f"q = torch.tensor([{pose}])  # shape (1, {len(pose)})\n"
        f"q_cmd = policy.predict_joints(q, policy.arm.forward(q + 0.01))  # rad, shape (1, {len(pose)})\n"
        "```\n\n"
        f"In LeRobot's terms (`select_action`) the target is the observation `{policy.config.target_pose_key}`, and "
        "commands come in the dataset's units. "
    )


def _data(training: TrainingFacts) -> str:
    motion = training.motion or "What motion it was trained on is not recorded."
    size = (
        f" {training.episodes:,} episodes, {training.frames:,} frames at {training.fps:g} a second."
        if training.episodes and training.frames and training.fps
        else ""
    )
    return f"Dataset: {_dataset(training.dataset)}. {motion}{size}\n"


def _training(policy: LearnedIKPolicy, training: TrainingFacts) -> str:
    config = policy.config
    rows: list[tuple[str, str]] = [
        ("dataset", _dataset(training.dataset)),
        ("target joints", "recorded command" if config.target == "action" else "state one frame later"),
        ("target pose", "recorded" if config.target_pose_recorded else "FK of the target joints"),
        *_method(policy),
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


def _method(policy: LearnedIKPolicy) -> list[tuple[str, str]]:
    """What the network sees, learns and is, by the kind of policy."""
    config: Any = policy.config
    parameters = f"{sum(parameter.numel() for parameter in policy.network.parameters()):,} parameters"
    fk_step = (
        "an optimiser step of its own" if config.fk_update == "separate" else "one sum with the objective"
    )
    rows = [
        ("FK consistency loss", f"weight {config.fk_weight:g}, in {fk_step}" if config.fk_weight else "none")
    ]
    if hasattr(config, "objective"):
        objective = _OBJECTIVES[config.objective].format(t_star=config.t_star, flow_steps=config.flow_steps)
        rows.insert(0, ("objective", objective))
    if config.type == _FORESIGHT:
        return [
            ("network sees", f"{config.n_obs_steps} targets and the commands after them"),
            (
                "tremor in training",
                f"0 to {config.tremor_mm:g} mm, half a degree per mm; none in {config.steady:.0%}",
            ),
            ("closed loop", f"driven by its own commands, anew every {config.rollout_every:,} steps"),
            *rows,
            ("network", f"{config.n_layers} layers, width {config.hidden_dim}, {parameters}"),
        ]
    sees = f"{config.n_obs_steps} frames: {_CONDITIONINGS[config.conditioning]}"
    size = (
        f"{config.n_layers} layers, width {config.d_model}, {config.n_heads} heads, {parameters}"
        if config.type == "mimicik"
        else parameters
    )
    return [("network sees", sees), *rows, ("network", size)]


def _limits(policy: LearnedIKPolicy) -> str:
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


def _step_bounds(policy: LearnedIKPolicy) -> tuple[list[float], list[float]]:
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
