"""Training the benchmark's learned rows by `lerobot-train`, each once, and noting what it cost."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_mimicik.evaluation import training_process
from lerobot_mimicik.evaluation.bench import LearnedRow, Summary
from lerobot_mimicik.evaluation.bench_options import BenchOptions
from lerobot_mimicik.evaluation.report import machine
from lerobot_mimicik.kinematics.arms import ArmDescription


@dataclass(frozen=True)
class Training:
    """One training of one row.

    Attributes:
        name: Row and seed.
        steps: Training steps.
        log_freq: Steps between two lines of its log.
        run: The folder that `lerobot-train` writes.
        arguments: Its command line.
    """

    name: str
    steps: int
    log_freq: int
    run: Path
    arguments: list[str]


def prepare_trainings(
    options: BenchOptions, description: ArmDescription, rows: Sequence[LearnedRow]
) -> dict[tuple[str, int], Training]:
    """Every training that the benchmark needs, by what is trained and seed.

    Raises:
        ValueError: If a row was trained with other options before.
        FileNotFoundError: If there is no such recipe.
    """
    out = options.out
    prepared = {}
    for row in rows:
        name = row.recipe(options.size)
        path = training_process.find_recipe(str(Path(options.recipes) / name) if options.recipes else name)
        recipe = json.loads(path.read_text())
        for seed in range(options.seeds):
            if (row.trained, seed) in prepared:
                continue
            training = Training(
                f"{row.trained}-seed{seed}",
                options.steps or int(recipe["steps"]),
                int(recipe.get("log_freq", 200)),
                out / "train" / f"{row.trained}-seed{seed}" / "run",
                [],
            )
            training.arguments.extend(
                [
                    f"--config_path={path}",
                    *_data_options(options),
                    f"--output_dir={training.run}",
                    f"--steps={training.steps}",
                    f"--seed={seed}",
                    *_arm_options(out / "arm.urdf", description),
                    *row.options(),
                    *([f"--policy.conditioning={options.conditioning}"] if options.conditioning else []),
                    *([f"--policy.device={options.device}"] if options.device else []),
                ]
            )
            # Where the recipe lies does not matter, what it says does.
            _keep_arguments(training, {"arguments": training.arguments[1:], "recipe": recipe})
            prepared[row.trained, seed] = training
    return prepared


def train_row(training: Training, summary: Summary, say: Callable[[str], None] = print) -> None:
    """Train to the end, and note in the summary the time that it took, over all interruptions.

    Raises:
        RuntimeError: If `lerobot-train` failed.
    """
    if training_process.last_step(training.run) >= training.steps:
        return
    say(f"Training {training.name}: {training.steps} steps")
    before = summary.training.get(training.name, {}).get("minutes", 0.0)
    begin = time.monotonic()
    try:
        training_process.train_or_resume(
            training.arguments,
            training.run,
            training.steps,
            training.log_freq,
            training.run.parent / "logs",
            say,
        )
    finally:
        summary.training[training.name] = {
            "steps": training_process.last_step(training.run),
            "minutes": before + (time.monotonic() - begin) / 60,
            "machine": f"{machine()['processor']}, device {_device_of(training.run) or 'unknown'}",
            "command": training_process.shown(training.arguments),
        }
        summary.save()


def _data_options(options: BenchOptions) -> list[str]:
    """The dataset, and what differs from the recipes' defaults about it."""
    return [
        f"--dataset.repo_id=local/{Path(options.train or '').resolve().name}",
        f"--dataset.root={options.train}",
        *([f"--dataset.episodes={list(options.train_episodes)}"] if options.train_episodes else []),
        *([f"--policy.joint_units={options.joint_units}"] if options.joint_units != "rad" else []),
        *([f"--policy.target={options.target}"] if options.target != "action" else []),
        *(
            [f"--policy.state_joint_names={json.dumps(options.state_joint_names)}"]
            if options.state_joint_names
            else []
        ),
    ]


def _arm_options(urdf: Path, arm: ArmDescription) -> list[str]:
    urdf.parent.mkdir(parents=True, exist_ok=True)
    urdf.write_text(arm.urdf)
    return [
        f"--policy.urdf={urdf}",
        f"--policy.base_link={arm.base_link}",
        f"--policy.tip_link={arm.tip_link}",
        f"--policy.joint_names={json.dumps(list(arm.joint_names))}",
        f"--policy.tool_offset={json.dumps(list(arm.tool_offset))}",
    ]


def _keep_arguments(training: Training, asked: dict) -> None:
    """Store a training's arguments, or check that they are the stored ones."""
    folder = training.run.parent
    kept = folder / "arguments.json"
    begun = training_process.last_step(training.run) > 0 and kept.is_file()
    if begun and json.loads(kept.read_text()) != asked:
        raise ValueError(
            f"{folder} was trained with other options ({kept}): take another --output, or remove it."
        )
    folder.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(asked, indent=2) + "\n")


def _device_of(run_folder: Path) -> str | None:
    file = run_folder / "checkpoints" / "last" / "pretrained_model" / "options.json"
    return json.loads(file.read_text())["device"] if file.is_file() else None
