"""`mimicik bench`: trains every learned row that is not trained yet, measures all rows, writes one table.

Everything is kept in the output folder, and running the command again goes on where it stopped::

    train/<row>-seed<n>/   run/ is what `lerobot-train` writes, logs/ what it prints
    summary.json           every row measured so far, saved after each, and what each training cost
    table.json, table.md   the rows asked for, learned ones over their seeds
    figures/               the same as PNG
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus

from lerobot_mimicik.cli import training_process
from lerobot_mimicik.cli.options import words

if TYPE_CHECKING:
    from lerobot_mimicik.evaluation.bench import LearnedRow, Summary
    from lerobot_mimicik.evaluation.evaluate import Recording
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
    # Rows: solvers by name, and the learned mimicik, mlp and unet_diffusion, each also with _nofk (no FK loss)
    # or _fk0.2 (that weight of it).
    solvers: str = "mimicik,mimicik_nofk,mlp,unet_diffusion,hold"
    # open_loop: recorded joints in at every frame. closed_loop: each command is the next measurement.
    modes: str = "open_loop,closed_loop"
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

    from lerobot_mimicik.data.writer import read_arm_json
    from lerobot_mimicik.evaluation.bench import LearnedRow, Summary, learned_names
    from lerobot_mimicik.evaluation.evaluate import study
    from lerobot_mimicik.evaluation.rollouts import known_modes
    from lerobot_mimicik.evaluation.trajectories import distinct_names, load_trajectories
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
    trained = _prepare_trainings(config, out, [row for row in rows.values() if row is not None])
    description = read_arm_json(config.train)
    arm = SerialArm(description, dtype=torch.float64)
    recordings = [
        study(arm, load_trajectories(root, arm, name=name))
        for root, name in zip(roots, distinct_names(roots), strict=True)
    ]
    summary = Summary(out / "summary.json")
    failed = False
    for name, row in rows.items():
        for seed in range(config.seeds if row is not None else 1):
            policy: str | None = None
            if row is not None:
                run_folder, arguments = trained[name, seed]
                try:
                    _train(config, row, seed, run_folder, arguments, summary)
                except RuntimeError as error:
                    # The other rows are still worth having; the exit status tells.
                    failed = True
                    summary.unavailable[name] = f"training failed: {str(error).splitlines()[0]}"
                    print(f"{name}, seed {seed}: {error}", flush=True)
                    break
                policy = str(run_folder)
            if not _measure(config, name, seed, policy, arm, recordings, modes, summary, progress):
                break
            _write(config, out, names, modes, recordings, summary)
    _write(config, out, names, modes, recordings, summary)
    return failed


def _prepare_trainings(
    config: BenchConfig, out: Path, rows: Sequence[LearnedRow]
) -> dict[tuple[str, int], tuple[Path, list[str]]]:
    """Output folder and command line of every training, by row and seed.

    Raises:
        ValueError: If a row was trained with other options before.
    """
    from lerobot_mimicik.data.writer import read_arm_json

    if not rows:
        return {}
    description = read_arm_json(config.train)
    out.mkdir(parents=True, exist_ok=True)
    urdf = out / "arm.urdf"
    urdf.write_text(description.urdf)
    prepared = {}
    for row in rows:
        name = row.recipe(config.size)
        recipe = training_process.find_recipe(str(Path(config.recipes) / name) if config.recipes else name)
        for seed in range(config.seeds):
            folder = out / "train" / f"{row.name}-seed{seed}"
            arguments = [
                f"--config_path={recipe}",
                f"--dataset.repo_id=local/{Path(config.train).resolve().name}",
                f"--dataset.root={config.train}",
                f"--output_dir={folder / 'run'}",
                f"--steps={_steps(config, recipe)}",
                f"--seed={seed}",
                *_arm_options(urdf, description),
                *row.options(),
                *([f"--policy.conditioning={config.conditioning}"] if config.conditioning else []),
                *([f"--policy.device={config.device}"] if config.device else []),
            ]
            kept = folder / "arguments.json"
            asked = {"arguments": arguments, "recipe": json.loads(recipe.read_text())}
            begun = training_process.last_step(folder / "run") > 0 and kept.is_file()
            if begun and json.loads(kept.read_text()) != asked:
                raise ValueError(
                    f"{folder} was trained with other options ({kept}): take another --out, or remove it."
                )
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(asked, indent=2) + "\n")
            prepared[row.name, seed] = (folder / "run", arguments)
    return prepared


def _arm_options(urdf: Path, arm: ArmDescription) -> list[str]:
    return [
        f"--policy.urdf={urdf}",
        f"--policy.base_link={arm.base_link}",
        f"--policy.tip_link={arm.tip_link}",
        f"--policy.joint_names={json.dumps(list(arm.joint_names))}",
        f"--policy.tool_offset={json.dumps(list(arm.tool_offset))}",
    ]


def _steps(config: BenchConfig, recipe: Path) -> int:
    return config.steps or int(json.loads(recipe.read_text())["steps"])


def _train(
    config: BenchConfig, row: LearnedRow, seed: int, run_folder: Path, arguments: list[str], summary: Summary
) -> None:
    """Train a row's policy to its end, and note the time it took, over all interruptions."""
    from lerobot_mimicik.evaluation.report import machine

    recipe = training_process.find_recipe(arguments[0].partition("=")[2])
    steps = _steps(config, recipe)
    if training_process.last_step(run_folder) >= steps:
        return
    print(f"Training {row.name}, seed {seed}: {steps} steps", flush=True)
    key = f"{row.name}-seed{seed}"
    before = summary.training.get(key, {}).get("minutes", 0.0)
    begin = time.monotonic()
    log_freq = int(json.loads(recipe.read_text()).get("log_freq", 200))
    try:
        training_process.train_or_resume(arguments, run_folder, steps, log_freq, run_folder.parent / "logs")
    finally:
        host: dict[str, Any] = machine()
        summary.training[key] = {
            "steps": training_process.last_step(run_folder),
            "minutes": before + (time.monotonic() - begin) / 60,
            "machine": f"{host['processor']}, device {_device_of(run_folder) or 'unknown'}",
            "command": training_process.shown(arguments),
        }
        summary.save()


def _device_of(run_folder: Path) -> str | None:
    file = run_folder / "checkpoints" / "last" / "pretrained_model" / "config.json"
    return json.loads(file.read_text())["device"] if file.is_file() else None


def _measure(
    config: BenchConfig,
    name: str,
    seed: int,
    policy: str | None,
    arm: SerialArm,
    recordings: Sequence[Recording],
    modes: Sequence[str],
    summary: Summary,
    progress: bool,
) -> bool:
    """Measure one solver wherever it was not measured before; False if it cannot be had."""
    from lerobot_mimicik.evaluation.evaluate import evaluate
    from lerobot_mimicik.solvers import make_solver

    missing = [
        (recording, mode)
        for recording in recordings
        for mode in modes
        if summary.find(name, seed, str(recording.set.root), mode) is None
    ]
    if not missing:
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
    for recording, mode in missing:
        for evaluation in evaluate(
            arm, {name: solver}, [recording], [mode], config.latency_queries, seed, progress
        ):
            summary.add(evaluation, seed, str(recording.set.root))
    return True


def _write(
    config: BenchConfig,
    out: Path,
    names: Sequence[str],
    modes: Sequence[str],
    recordings: Sequence[Recording],
    summary: Summary,
) -> None:
    """The table and figures of what was asked for, as far as it is measured."""
    from lerobot_mimicik.configuration_mimicik import MimicIKConfig
    from lerobot_mimicik.evaluation.bench import write_table
    from lerobot_mimicik.evaluation.bench_plots import plot_errors, plot_fk_weights
    from lerobot_mimicik.evaluation.report import describe_recording

    asked = [
        (summary.find(name, seed, str(recording.set.root), mode), recording.set.name)
        for recording in recordings
        for mode in modes
        for name in names
        for seed in range(config.seeds)
    ]
    # A dataset's name is told from the others asked for now, which may be others than before.
    rows = [row | {"dataset": dataset} for row, dataset in asked if row is not None]
    about = [describe_recording(recording) for recording in recordings]
    notes = [
        f"{data['name']}: {data['episodes']} episodes, {data['frames']} frames at {data['fps']:g} fps."
        + (" Its joint labels are synthetic (generated or retargeted)." if data["synthetic_labels"] else "")
        for data in about
    ]
    summary.save()
    write_table(out, rows, summary.training, summary.unavailable, asdict(config) | {"datasets": about}, notes)
    if rows:
        plots = [*plot_errors(rows), plot_fk_weights(rows, MimicIKConfig.fk_weight)]
        for plot in plots:
            if plot is not None:
                plot.save(out / "figures")
