"""`mimicik eval`: measures a checkpoint on recorded motion and writes report.html, report.json and report.md."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_mimicik import outputs
from lerobot_mimicik.cli.options import join_repeated, numbers, parse, say_loading, spelled, words
from lerobot_mimicik.kinematics.names import did_you_mean

if TYPE_CHECKING:
    from lerobot_mimicik.evaluation.evaluate import Evaluation
    from lerobot_mimicik.kinematics.arms import ArmDescription
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy
    from lerobot_mimicik.solvers import IKSolver

HELP = "Measure a checkpoint on recorded motion: accuracy, smoothness, latency, behaviour at singularities."


@dataclass
class PolicySource:
    """The checkpoint to measure."""

    # A checkpoint's folder, the output folder of a training run, or a Hub repository. Empty: measure only
    # solvers that need none.
    path: str = ""


@dataclass
class DatasetSource:
    """The recorded motion to measure on."""

    # Folder of a LeRobot dataset; several separated by commas, or the option repeated.
    root: str = ""


@dataclass
class EvalConfig:
    """Options of `mimicik eval`.

    Example: `mimicik eval --policy.path=outputs/demo/train --dataset=outputs/demo/data/test --solvers=mimicik,guided`
    """

    policy: PolicySource = field(default_factory=PolicySource)
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # open_loop: recorded joints in at every frame. closed_loop: each command is the next measurement.
    modes: str = "open_loop,closed_loop"
    # Where report.html, report.json and report.md go.
    output: str = "outputs/eval"
    # Rows of the table; hold (the arm does not move) is always among them. mimicik is the checkpoint of
    # --policy.path, and its row is named after its kind: mimicik, mimicik_nofk, mlp or unet_diffusion;
    # mimicik_guided is what the adapter makes of it.
    solvers: str = "mimicik,hold"
    # Episodes to use, as numbers and ranges such as 0-9,12; empty: all of them.
    episodes: str = ""
    # The datasets' joints: rad or deg; empty: as the checkpoint was trained, rad without one.
    joint_units: str = ""
    # For solvers that draw noise.
    seed: int = 0
    # Where the policy runs (cpu, cuda, mps); empty: as its configuration says.
    device: str = ""
    # Number of single queries timed for the latency.
    latency_queries: int = 200
    # Threads that torch uses; 0 leaves it to torch.
    threads: int = 0


def main(argv: Sequence[str]) -> int:
    """Run the command."""
    arguments = join_repeated(spelled(argv, EvalConfig), "--dataset.root")
    config = parse(EvalConfig, arguments, "mimicik eval")
    rows: list[dict[str, Any]] = []
    with outputs.alone(config.output):
        run(config, rows=rows, command=shlex.join(["mimicik", "eval", *arguments]))
    from lerobot_mimicik.evaluation.short_table import measured, screen_table

    print(screen_table(*measured(rows)))
    print(f"Report: {config.output}/report.html; all columns: {config.output}/report.md")
    return 0


def run(
    config: EvalConfig,
    progress: bool = True,
    rows: list[dict[str, Any]] | None = None,
    command: str = "",
) -> list[Evaluation]:
    """Evaluate and write the report, after every row anew so that an interrupted run leaves what it has.

    A solver that cannot run here is a row with the reason.

    Args:
        config: What to do.
        progress: Whether to show bars.
        rows: Takes the rows of the report, those of unavailable solvers among them.
        command: The command line, for the page.

    Raises:
        ValueError: If an option does not fit; the message names it and what exists.
        FileExistsError: If a report is there that this project did not write.
        FileNotFoundError: If a dataset or checkpoint does not exist.
    """
    roots = words(config.dataset.root)
    if not roots:
        raise ValueError("--dataset.root is missing: the folder of a LeRobot dataset.")
    _check_paths(config, roots)
    if progress:
        say_loading()
    import torch

    from lerobot_mimicik.checkpoints import FORESIGHT_SOLVERS, LEARNED, kind_of, load_policy, solvers_of
    from lerobot_mimicik.evaluation.evaluate import evaluate, study
    from lerobot_mimicik.evaluation.report import unavailable_row, write_report
    from lerobot_mimicik.evaluation.result_pages import write_eval_page
    from lerobot_mimicik.evaluation.rollouts import known_modes
    from lerobot_mimicik.evaluation.short_table import measured
    from lerobot_mimicik.evaluation.trajectories import Layout, distinct_names, load_trajectories
    from lerobot_mimicik.kinematics.chain import SerialArm
    from lerobot_mimicik.solvers import SolverUnavailable, known_solvers, make_solver

    modes = _known(words(config.modes), known_modes(), "--modes")
    names = _known(words(config.solvers), known_solvers(), "--solvers")
    names += [] if "hold" in names else ["hold"]
    learned = [name for name in names if name in (*LEARNED, "mimicik_guided")]
    if learned and not config.policy.path:
        if words(config.solvers) != words(EvalConfig.solvers):
            raise ValueError(f"--solvers names {learned[0]}, but --policy.path is missing: which checkpoint?")
        names = [name for name in names if name not in learned]
        learned = []
    outputs.claim(config.output, "report")
    if config.threads:
        torch.set_num_threads(config.threads)

    policy: LearnedIKPolicy | None = None
    kind = ""
    if learned or (config.policy.path and not {*names}.isdisjoint(FORESIGHT_SOLVERS)):
        policy = load_policy(config.policy.path, config.device or None)
        kind = kind_of(policy.config)
        others = [name for name in learned if name not in ("mimicik", "mimicik_guided", kind)]
        if others:
            raise ValueError(
                f"--solvers names {others[0]}, but {config.policy.path} is a checkpoint of {kind}."
            )
        names = list(dict.fromkeys(kind if name in LEARNED else name for name in names))
    description = policy.config.arm_description() if policy is not None else _arm_of_dataset(roots[0])
    layout = Layout.of_policy(policy.config) if policy is not None else Layout()
    if config.joint_units:
        (units,) = _known([config.joint_units], ("rad", "deg"), "--joint_units")
        layout = replace(layout, joint_units=units)
    arm = SerialArm(description, dtype=torch.float64)
    episodes = numbers(config.episodes, "--episodes") or None
    recordings = [
        study(arm, load_trajectories(root, arm, layout, episodes, name))
        for root, name in zip(roots, distinct_names(roots), strict=True)
    ]
    rows = [] if rows is None else rows
    solvers: dict[str, IKSolver] = {}
    for name in names:
        chosen = {"policy": policy} if kind and name in solvers_of(kind) else {}
        try:
            solvers[name] = make_solver(name, arm, **chosen)
        except (SolverUnavailable, ImportError) as error:
            rows.append(unavailable_row(name, str(error)))
    settings = asdict(config) | {"device": str(policy.config.device) if policy is not None else "cpu"}
    if policy is not None:
        settings["weights"] = policy.digest()
    evaluations: list[Evaluation] = []
    for evaluation in evaluate(
        arm,
        solvers,
        recordings,
        modes,
        config.latency_queries,
        config.seed,
        progress,
        lambda *why: rows.append(unavailable_row(why[0], why[3], why[1], why[2])),
    ):
        evaluations.append(evaluation)
        rows.append(evaluation.row)
        write_report(config.output, rows, recordings, settings)
    write_report(config.output, rows, recordings, settings)
    write_eval_page(Path(config.output), evaluations, arm.joint_names, measured(rows)[1], command)
    return evaluations


def _check_paths(config: EvalConfig, roots: list[str]) -> None:
    """Say what does not exist before seconds go into imports."""
    from lerobot_mimicik.checkpoints import check_device, find_checkpoint
    from lerobot_mimicik.inputs import check_dataset

    for root in roots:
        check_dataset(root, "--dataset.root")
    if config.policy.path:
        find_checkpoint(config.policy.path)
    if config.device:
        check_device(config.device)


def _known(asked: list[str], known: Sequence[str], option: str) -> list[Any]:
    unknown = [name for name in asked if name not in known]
    if unknown or not asked:
        raise ValueError(
            f"{option}: unknown {', '.join(unknown) or '(nothing)'}; known are {', '.join(known)}."
            + did_you_mean("".join(unknown[:1]), known)
        )
    return list(dict.fromkeys(asked))


def _arm_of_dataset(root: str) -> ArmDescription:
    from lerobot_mimicik.data.writer import read_arm_json

    return read_arm_json(root)
