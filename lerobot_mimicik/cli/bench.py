"""`mimicik bench`: measures solvers on recorded motion side by side; see `evaluation.bench_run`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus

from lerobot_mimicik.cli.options import numbers, words

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
    # Elements of the datasets' states and actions that are the joints, in joint order and separated by commas, or
    # their positions (0,1,2,...); empty: found by the arm's joint names.
    state_joint_names: str = ""
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
    if not words(config.datasets) or not config.train:
        raise ValueError("--datasets and --train are needed: folders of LeRobot datasets.")
    from lerobot_mimicik.inputs import check_dataset, check_exists
    from lerobot_mimicik.kinematics.arms import describe_arm

    for root in words(config.datasets):
        check_dataset(root, "--datasets")
    check_dataset(config.train, "--train")
    if config.recipes:
        check_exists(config.recipes, "--recipes")
    if config.urdf:
        describe_arm(config.urdf)
    from lerobot_mimicik.evaluation.bench_run import BenchOptions, run_bench

    options = BenchOptions(
        datasets=tuple(Path(root) for root in words(config.datasets)),
        train=Path(config.train),
        arm=config.urdf,
        joint_units=config.joint_units,
        target=config.target,
        state_joint_names=tuple(words(config.state_joint_names)),
        train_episodes=tuple(numbers(config.train_episodes, "--train_episodes")),
        episodes=tuple(numbers(config.episodes, "--episodes")),
        solvers=tuple(dict.fromkeys(words(config.solvers))),
        modes=tuple(dict.fromkeys(words(config.modes))),
        seconds=config.seconds,
        plant_seconds=config.plant_seconds,
        seeds=config.seeds,
        steps=config.steps,
        size=config.size,
        recipes=config.recipes,
        conditioning=config.conditioning,
        out=Path(config.out),
        device=config.device,
        latency_queries=config.latency_queries,
    )
    return run_bench(options, asdict(config), progress)
