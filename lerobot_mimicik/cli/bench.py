"""`mimicik bench`: trains every learned row that is not trained yet, measures all rows, writes one table.

Everything is kept in the output folder, and running the command again goes on where it stopped::

    train/<row>-seed<n>/   run/ is what `lerobot-train` writes, logs/ what it prints
    summary.json           every row measured so far, saved after each, and what each training cost
    anatomy/<row>.npz      its commands through singularities and out of reach
    table.json, table.md   the rows asked for, learned ones over their seeds
    figures/               the same as PNG, a caption beside each
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus

from lerobot_mimicik.cli.options import numbers, words

if TYPE_CHECKING:
    from lerobot_mimicik.evaluation.anatomy import Ordeal
    from lerobot_mimicik.evaluation.bench import Summary
    from lerobot_mimicik.evaluation.evaluate import Recording
    from lerobot_mimicik.evaluation.plots import Plot
    from lerobot_mimicik.kinematics.arms import ArmDescription
    from lerobot_mimicik.kinematics.chain import SerialArm

HELP = "Compare solvers: train the learned ones, measure all of them on recorded motion, write one table."


@dataclass
class BenchConfig:
    """Options of `mimicik bench`."""

    # Folders of the LeRobot datasets to measure on, separated by commas.
    datasets: str = ""
    # Folder of the LeRobot dataset to train on, made by mimicik make-dataset: it names the arm.
    train: str = ""
    # The datasets' arm where they do not say: a shipped one (airbot_play, piper) or the path of a URDF.
    urdf: str = ""
    # rad or deg: the datasets' joints.
    joint_units: str = "rad"
    # Target joints are the recorded action, or the next_state.
    target: str = "action"
    # Episodes to train on and to measure on, as numbers and ranges such as 0-9,12; empty: all of them.
    train_episodes: str = ""
    episodes: str = ""
    # Rows: solvers by name, and the learned mimicik, mlp and unet_diffusion, each also with _nofk (no FK loss)
    # or _fk0.2 (that weight of it).
    solvers: str = "mimicik,mimicik_nofk,mlp,unet_diffusion,hold"
    # open_loop: recorded joints in at every frame. closed_loop: each command is the next measurement. plant:
    # the commands drive a simulated AIRBOT Play over its bus, and what that measures is the next measurement;
    # plant_commanded: the same, but the solver is told the command in force.
    modes: str = "open_loop,closed_loop"
    # Measure on the first seconds of each episode only; 0: on all of it.
    seconds: float = 0.0
    # Modes plant run at a few times real time: drive only the first so many seconds of each dataset; 0: all.
    plant_seconds: float = 0.0
    # Trainings of each learned row, with the seeds 0, 1, ...
    seeds: int = 1
    # Training steps; 0: as the recipes say.
    steps: int = 0
    # Which recipes: small or paper.
    size: str = "small"
    # Folder of the recipes; empty: the ones that come with the project.
    recipes: str = ""
    # Conditioning of all learned rows (relative, paper); empty: as the recipes say.
    conditioning: str = ""
    # Folder for everything that is made.
    out: str = "outputs/bench"
    # Where to train and evaluate (cpu, cuda, mps); empty: what LeRobot finds.
    device: str = ""
    # Number of single queries timed for the latency.
    latency_queries: int = 200


@dataclass(frozen=True)
class Occasion:
    """What each solver is measured on.

    Attributes:
        recording: A dataset, or the part of it that is used.
        mode: How it is driven along it.
        place: The dataset's folder and which part of it, as the summary knows it.
    """

    recording: Recording
    mode: str
    place: str


def main(argv: Sequence[str]) -> int:
    """Run the command; 1 if a training failed."""
    config = draccus.parse(BenchConfig, args=list(argv), prog="mimicik bench")
    failed = run(config)
    print((Path(config.out) / "table.md").read_text())
    return int(failed)


def run(config: BenchConfig, progress: bool = True) -> bool:
    """Train, measure and write; returns whether a training failed.

    Raises:
        ValueError: If an option does not fit, or a row was trained with other options before.
        FileNotFoundError: If a dataset or recipe does not exist.
    """
    import torch

    from lerobot_mimicik.cli.bench_training import prepare_trainings, train_row
    from lerobot_mimicik.evaluation.anatomy import make_ordeals
    from lerobot_mimicik.evaluation.bench import LearnedRow, Summary, learned_names
    from lerobot_mimicik.evaluation.evaluate import study
    from lerobot_mimicik.evaluation.rollouts import known_modes
    from lerobot_mimicik.evaluation.trajectories import (
        Layout,
        distinct_names,
        first_seconds,
        load_trajectories,
    )
    from lerobot_mimicik.kinematics.chain import SerialArm
    from lerobot_mimicik.solvers import known_solvers

    roots = words(config.datasets)
    if not roots or not config.train:
        raise ValueError("--datasets and --train are needed: folders of LeRobot datasets.")
    if config.seeds < 1:
        raise ValueError(f"--seeds={config.seeds}: expected at least 1.")
    modes = list(dict.fromkeys(words(config.modes)))
    for mode in modes:
        if mode not in known_modes():
            raise ValueError(f"--modes: unknown {mode}; known are {', '.join(known_modes())}.")
    names = list(dict.fromkeys(words(config.solvers)))
    rows = {name: LearnedRow.of(name) for name in names}
    others = [name for name in known_solvers() if LearnedRow.of(name) is None]
    for name, row in rows.items():
        if row is None and name not in others:
            raise ValueError(
                f"--solvers: unknown {name}; known are {learned_names()}, and {', '.join(others)}."
            )
    out = Path(config.out)
    description = _arm(config)
    trainings = prepare_trainings(config, description, [row for row in rows.values() if row is not None])
    arm = SerialArm(description, dtype=torch.float64)
    layout = Layout(joint_units=config.joint_units, target=config.target)
    episodes = numbers(config.episodes, "--episodes") or None
    ordeals = make_ordeals(description) if description.home else []
    occasions: list[Occasion] = []
    for root, name in zip(roots, distinct_names(roots), strict=True):
        whole = load_trajectories(root, arm, layout, episodes, name)
        kept = study(arm, first_seconds(whole, of_each=config.seconds or math.inf))
        for mode in modes:
            if mode.startswith("plant") and config.plant_seconds:
                part = study(arm, first_seconds(kept.set, in_all=config.plant_seconds))
                occasions.append(Occasion(part, mode, _place(config, root, config.plant_seconds)))
            else:
                occasions.append(Occasion(kept, mode, _place(config, root)))
    summary = Summary(out / "summary.json")
    failed = False
    for name, row in rows.items():
        for seed in range(config.seeds if row is not None else 1):
            policy: str | None = None
            if row is not None:
                training = trainings[name, seed]
                try:
                    train_row(training, summary)
                except RuntimeError as error:
                    # The other rows are still worth having; the exit status tells.
                    failed = True
                    summary.unavailable[name] = f"training failed: {str(error).splitlines()[0]}"
                    print(f"{name}, seed {seed}: {error}", flush=True)
                    break
                policy = str(training.run)
            if not _measure(config, name, seed, policy, arm, occasions, ordeals, summary, progress):
                break
            _write(config, out, names, occasions, summary)
    _write(config, out, names, occasions, summary)
    _write_anatomy(out, names, arm, ordeals)
    return failed


def _arm(config: BenchConfig) -> ArmDescription:
    """The arm of --urdf, else that of the training data."""
    from lerobot_mimicik.data.writer import ARM_FILE, read_arm_json
    from lerobot_mimicik.kinematics.arms import describe_arm

    if config.urdf:
        return describe_arm(config.urdf)
    if not (Path(config.train) / ARM_FILE).is_file():
        raise ValueError(f"{config.train} does not name its arm ({ARM_FILE}): which is it? --urdf=...")
    return read_arm_json(config.train)


def _measure(
    config: BenchConfig,
    name: str,
    seed: int,
    policy: str | None,
    arm: SerialArm,
    occasions: Sequence[Occasion],
    ordeals: Sequence[Ordeal],
    summary: Summary,
    progress: bool,
) -> bool:
    """Measure one solver wherever it was not measured before; False if it cannot be had."""
    from lerobot_mimicik.evaluation.anatomy import save_commands, undergo
    from lerobot_mimicik.evaluation.evaluate import evaluate_one
    from lerobot_mimicik.evaluation.latency import measure_latency
    from lerobot_mimicik.solvers import make_solver

    missing = [each for each in occasions if summary.find(name, seed, each.place, each.mode) is None]
    commands = _commands_file(Path(config.out), name)
    undergoes = bool(ordeals) and seed == 0 and not commands.is_file()
    if not missing and not undergoes:
        return True
    options: dict[str, Any] = {}
    if policy is not None:
        options = {"policy": policy, "device": config.device or None}
    try:
        solver = make_solver("mimicik" if policy is not None else name, arm, **options)
    except (RuntimeError, ImportError) as error:
        summary.unavailable[name] = str(error)
        print(f"{name} is unavailable: {error}", flush=True)
        return False
    if missing:
        latency = measure_latency(solver, missing[0].recording.set.trajectories[0], config.latency_queries)
    for each in missing:
        evaluation = evaluate_one(arm, name, solver, each.recording, each.mode, latency, seed, progress)
        summary.add(evaluation, seed, each.place)
    if undergoes:
        save_commands(commands, undergo(solver, ordeals))
    return True


def _place(config: BenchConfig, root: str, in_all: float = 0.0) -> str:
    """What was measured on, as the summary knows it."""
    return "".join(
        [
            str(Path(root)),
            f", episodes {config.episodes}" if config.episodes else "",
            f", first {config.seconds:g} s of each" if config.seconds else "",
            f", first {in_all:g} s in all" if in_all else "",
        ]
    )


def _commands_file(out: Path, name: str) -> Path:
    return out / "anatomy" / f"{name}.npz"


def _write_anatomy(out: Path, names: Sequence[str], arm: SerialArm, ordeals: Sequence[Ordeal]) -> None:
    """The figure of the standard motions, learned rows with their first seed."""
    from lerobot_mimicik.evaluation.anatomy import load_commands
    from lerobot_mimicik.evaluation.bench_plots import plot_anatomy
    from lerobot_mimicik.evaluation.metrics import measure

    files = {name: _commands_file(out, name) for name in names}
    traces = {
        name: measure(arm, list(load_commands(file, ordeals).values()))
        for name, file in files.items()
        if ordeals and file.is_file()
    }
    if traces:
        _save_plots(out, [plot_anatomy(ordeals, traces, arm.joint_names)])


def _write(
    config: BenchConfig,
    out: Path,
    names: Sequence[str],
    occasions: Sequence[Occasion],
    summary: Summary,
) -> None:
    """The table and figures of what was asked for, as far as it is measured."""
    from lerobot_mimicik.configuration_mimicik import MimicIKConfig
    from lerobot_mimicik.evaluation.bench import LearnedRow, write_table
    from lerobot_mimicik.evaluation.bench_plots import plot_errors, plot_fk_weights, plot_seeds
    from lerobot_mimicik.evaluation.report import describe_recording
    from lerobot_mimicik.solvers import solver_configuration

    asked = [
        (summary.find(name, seed, each.place, each.mode), each.recording.set.name)
        for each in occasions
        for name in names
        for seed in range(config.seeds)
    ]
    # A dataset's name is told from the others asked for now, which may be others than before.
    rows = [row | {"dataset": dataset} for row, dataset in asked if row is not None]
    about = [describe_recording(each.recording) | {"mode": each.mode} for each in occasions]
    notes = [
        f"{data['name']}, {data['mode'].replace('_', ' ')}: {data['episodes']} episodes, {data['frames']} "
        f"frames at {data['fps']:g} fps."
        + (" Its joint labels are synthetic (generated or retargeted)." if data["synthetic_labels"] else "")
        for data in about
    ]
    summary.save()
    learned = {name: LearnedRow.of(name) for name in names}
    configurations = {
        name: solver_configuration(name) if row is None else row.configuration(config.size)
        for name, row in learned.items()
    }
    settings = asdict(config) | {"datasets": about}
    write_table(out, rows, summary.training, summary.unavailable, settings, notes, configurations)
    if rows:
        _save_plots(
            out, [*plot_errors(rows), plot_fk_weights(rows, MimicIKConfig.fk_weight), plot_seeds(rows)]
        )


def _save_plots(out: Path, plots: Sequence[Plot | None]) -> None:
    """Figures that can be drawn, as PNG with the caption beside it."""
    for plot in plots:
        if plot is not None:
            plot.save(out / "figures").with_suffix(".txt").write_text(f"{plot.title}\n\n{plot.caption}\n")
