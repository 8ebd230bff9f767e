"""`mimicik demo`: the whole way in one command, from motion to a trained, evaluated checkpoint and a report.

The stages leave their results in the output folder, and a run with `--resume` goes on after the last
complete one:

    data/     datasets: train, test (held-out sessions), ood (near singularities)
    train/    what `lerobot-train` writes; the checkpoint is train/checkpoints/last/pretrained_model
    logs/     what `lerobot-train` prints
    eval/     report.json and report.md, as `mimicik eval` writes them
    figures/  the report's figures as PNG
    report.html
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from lerobot_mimicik import outputs
from lerobot_mimicik.cli.options import decimals, parse, say_loading
from lerobot_mimicik.evaluation import training_process

HELP = "Go the whole way: make a dataset, train a policy on it, measure it, write a report with figures."

# What a demo measures: the policy alone, the guided solver without it, and holding still.
SOLVERS = "mimicik,guided,hold"
_STATE = "demo.json"
_NEW_EACH_TIME = ("output", "resume", "overwrite", "workers", "device", "picture")
# Enough to see over-fitting in the training curves, little enough to cost seconds.
_HELD_OUT_SHARE, _HELD_OUT_SAMPLES, _EVALUATIONS = 0.05, 2048, 10


@dataclass
class DemoConfig:
    """Options of `mimicik demo`.

    Example: `mimicik demo --steps=500 --output=outputs/demo`
    """

    # synthetic: generated teleoperation. ee: recorded end-effector motion, given by --input.
    source: str = "synthetic"
    # source=ee: file, folder or LeRobot dataset with end-effector motion (see mimicik make-dataset --help).
    input: str = ""
    # A shipped arm (`mimicik arms` lists them) or the path of a URDF.
    arm: str = "airbot_play"
    # Comfortable configuration to begin from, in the joints' order [rad, m], comma-separated; empty: the arm's own,
    # else one that is found.
    home: str = ""
    # Folder for everything that is made.
    output: str = "outputs/demo"
    # Episodes of the dataset. source=ee: recordings used, 0 for all.
    episodes: int = 200
    # Share of the sessions that is kept aside for testing.
    test_share: float = 0.15
    # Length of each of the three near-singular test trajectories [s].
    ood_seconds: float = 120.0
    # Training steps; 0: as the recipe says.
    steps: int = 0
    # Recipe of the training: a file for lerobot-train --config_path, or its name in configs/.
    recipe: str = "small.json"
    # Of data, training and evaluation.
    seed: int = 0
    # Where to train and evaluate (cpu, cuda, mps); empty: what LeRobot finds.
    device: str = ""
    # Processes that make the data.
    workers: int = 2
    # Go on with what is in the output folder.
    resume: bool = False
    # Replace what is in the output folder.
    overwrite: bool = False
    # Only draw the arm through its singularity, beside LeRobot's own inverse kinematics or an undamped solver, into
    # this file (GIF).
    picture: str = ""


@dataclass(frozen=True)
class DemoData:
    """Folders of the datasets, and what was said when they were made."""

    train: Path
    test: Path
    ood: Path
    summary: str


def main(argv: Sequence[str]) -> int:
    """Run the command."""
    config = parse(DemoConfig, argv, "mimicik demo")
    if config.picture:
        draw_picture(config)
        return 0
    begin = time.monotonic()
    with outputs.alone(config.output):
        page = run(config)
    minutes, seconds = divmod(round(time.monotonic() - begin), 60)
    print(f"\nDone in {minutes} min {seconds} s. Report: {page}")
    return 0


def run(config: DemoConfig) -> Path:
    """All stages; returns the path of the report.

    Raises:
        ValueError: If an option does not fit, or differs from those of the run to be resumed.
        OSError: If an input does not exist, or the output folder is in use.
        RuntimeError: If training fails.
    """
    if config.source not in ("synthetic", "ee"):
        raise ValueError(f"--source must be synthetic or ee, got {config.source!r}.")
    if (config.source == "ee") != bool(config.input):
        raise ValueError("--source=ee needs --input, the recorded motion; --source=synthetic takes none.")
    from lerobot_mimicik.checkpoints import check_device
    from lerobot_mimicik.inputs import check_exists
    from lerobot_mimicik.kinematics.arms import describe_arm

    if config.input:
        check_exists(config.input, "--input")
    describe_arm(config.arm)
    if config.device:
        check_device(config.device)
    output = Path(config.output)
    recipe = training_process.find_recipe(config.recipe)
    _claim(output, config)
    print("1/4  Data", flush=True)
    data = make_data(config, output / "data")
    print(data.summary, flush=True)
    print("2/4  Training", flush=True)
    steps, log_freq, command = train_policy(config, recipe, data, output)
    print("3/4  Evaluation", flush=True)
    from lerobot_mimicik.cli.eval import DatasetSource, EvalConfig, PolicySource
    from lerobot_mimicik.cli.eval import run as evaluate

    eval_config = EvalConfig(
        policy=PolicySource(str(output / "train")),
        dataset=DatasetSource(f"{data.test},{data.ood}"),
        output=str(output / "eval"),
        solvers=SOLVERS,
        seed=config.seed,
        device=config.device,
    )
    evaluations = evaluate(eval_config)
    print("4/4  Report", flush=True)
    from lerobot_mimicik.evaluation.demo_report import write_demo_report

    curves = training_process.read_curves(output / "logs", log_freq)
    eval_command = (
        f"mimicik eval --policy.path={output / 'train'} --dataset.root={data.test},{data.ood} "
        f"--output={output / 'eval'} --solvers={SOLVERS}"
    )
    return write_demo_report(
        output,
        source=config.source,
        train_root=data.train,
        data_summary=data.summary,
        evaluations=evaluations,
        curves=curves,
        steps=steps,
        commands=[command, eval_command],
    )


def draw_picture(config: DemoConfig) -> None:
    """Draw the animation of `--picture` and say what it shows.

    Raises:
        ValueError: If there is no such arm, or it has no singularity to be led through.
        FileExistsError: If the file is there and is not such a picture.
    """
    from lerobot_mimicik.kinematics.arms import describe_arm

    path = Path(config.picture)
    description = describe_arm(config.arm)
    outputs.check_file(path, "--picture", outputs.PICTURE_MARK)
    say_loading()
    from lerobot_mimicik.data.home import with_home
    from lerobot_mimicik.evaluation.demo_report import singularity_animation

    animation = singularity_animation(with_home(description, decimals(config.home, "--home")))
    if animation is None:
        raise ValueError(
            f"--picture: the arm {config.arm} has no wrist, elbow or shoulder singularity to show."
        )
    path.write_bytes(animation.data)
    print(f"{animation.caption}\nPicture: {path}")


def make_data(config: DemoConfig, folder: Path) -> DemoData:
    """Make the datasets, or take those that are already complete.

    Raises:
        ValueError: If an option does not fit.
        OSError: If the input does not exist.
    """
    from lerobot_mimicik.data.home import with_home
    from lerobot_mimicik.data.teleoperation.session import SyntheticConfig
    from lerobot_mimicik.data.teleoperation.synthetic import make_synthetic
    from lerobot_mimicik.kinematics.arms import describe_arm

    train, test = folder / "train", folder / "test"
    ood = folder / "ood" if config.source == "synthetic" else folder / "near_singular" / "ood"
    note = folder / "summary.txt"
    if note.is_file() and all(_is_dataset(root) for root in (train, test, ood)):
        return DemoData(train, test, ood, note.read_text())
    description = with_home(describe_arm(config.arm), decimals(config.home, "--home"))
    if config.source == "synthetic":
        made = make_synthetic(
            folder,
            config.episodes,
            description,
            seed=config.seed,
            workers=config.workers,
            test_share=config.test_share,
            config=SyntheticConfig(ood_s=config.ood_seconds),
            overwrite=True,
        )
        summary = str(made)
    else:
        from lerobot_mimicik.cli.make_dataset import MakeDatasetConfig, RobotOptions
        from lerobot_mimicik.cli.make_dataset import run as make_dataset

        retargeted = make_dataset(
            MakeDatasetConfig(
                source="ee",
                input=config.input,
                output=str(folder),
                robot=RobotOptions(name=config.arm, home=",".join(map(str, description.home))),
                episodes=config.episodes,
                test_share=config.test_share,
                seed=config.seed,
                workers=config.workers,
                resume=config.resume,
                overwrite=not config.resume,
            )
        )
        # Recorded motion has no near-singular set; this one is generated, without lag as the rest.
        near_singular = make_synthetic(
            folder / "near_singular",
            1,
            description,
            seed=config.seed,
            workers=config.workers,
            test_share=0.0,
            config=SyntheticConfig(ood_s=config.ood_seconds, lag_s=0.0),
            overwrite=True,
        )
        frames = near_singular.frames["ood"]
        summary = f"{retargeted}\nnear-singular trajectories, generated: {frames} frames -> {ood}"
    note.write_text(summary)
    return DemoData(train, test, ood, summary)


def train_policy(config: DemoConfig, recipe: Path, data: DemoData, output: Path) -> tuple[int, int, str]:
    """Train with `lerobot-train`, from the last checkpoint if there is one.

    Returns:
        Training steps, steps between two lines of the log, and the command line.

    Raises:
        RuntimeError: If training fails.
    """
    settings = json.loads(recipe.read_text())
    steps = config.steps or int(settings["steps"])
    log_freq = min(int(settings.get("log_freq", 200)), max(1, steps // 20))
    run = output / "train"
    fresh = [
        f"--config_path={recipe}",
        f"--dataset.repo_id=local/{output.name}",
        f"--dataset.root={data.train}",
        f"--output_dir={run}",
        f"--steps={steps}",
        f"--log_freq={log_freq}",
        f"--seed={config.seed}",
        *_held_out(data.train, steps),
        f"--policy.urdf={config.arm}",
        *([f"--policy.device={config.device}"] if config.device else []),
    ]
    training_process.train_or_resume(fresh, run, steps, log_freq, output / "logs")
    return steps, log_freq, training_process.shown(fresh)


def _held_out(root: Path, steps: int) -> list[str]:
    """Options that keep a few training episodes aside for a loss curve, where there are enough of them."""
    info = json.loads((root / "meta" / "info.json").read_text())
    if info["total_episodes"] < 10 * max(1, info["total_tasks"]):
        return []
    return [
        f"--dataset.eval_split={_HELD_OUT_SHARE}",
        f"--max_eval_samples={_HELD_OUT_SAMPLES}",
        f"--eval_steps={max(1, steps // _EVALUATIONS)}",
    ]


def _claim(output: Path, config: DemoConfig) -> None:
    """Make the output folder this run's, or refuse.

    Raises:
        FileExistsError: If it holds something that may not be gone on with, or not be replaced.
        ValueError: If an input lies in it, or it holds a run with other options than those to be resumed with.
    """
    options = {name: value for name, value in asdict(config).items() if name not in _NEW_EACH_TIME}
    state = output / _STATE
    if config.resume and config.overwrite:
        raise ValueError("--resume goes on with what is there and --overwrite replaces it: choose one.")
    outputs.check_apart(output, [config.input] if config.input else [])
    if output.is_dir() and any(output.iterdir()):
        if not config.overwrite and not config.resume:
            raise FileExistsError(
                f"{output} exists already. --resume goes on with it, --overwrite replaces it, "
                "--output=DIR goes elsewhere."
            )
        if config.overwrite:
            outputs.check_new(output, "demo", overwrite=True)
            outputs.remove(output)
        elif state.is_file():
            before = json.loads(state.read_text())
            changed = [name for name, value in options.items() if before.get(name) != value]
            if changed:
                found = ", ".join(f"{name}={before.get(name)!r}" for name in changed)
                raise ValueError(f"{output} was begun with {found}: resume with that, or use --overwrite.")
    outputs.claim(output, "demo")
    state.write_text(json.dumps(options, indent=2) + "\n")


def _is_dataset(root: Path) -> bool:
    return (root / "meta" / "info.json").is_file()
