"""`mimicik bench`: measures solvers on recorded motion side by side; see `evaluation.bench_run`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_mimicik import outputs
from lerobot_mimicik.checkpoints import find_checkpoint
from lerobot_mimicik.cli.eval import PolicySource
from lerobot_mimicik.cli.options import numbers, parse, say_loading, words

if TYPE_CHECKING:
    from lerobot_mimicik.evaluation.bench_run import BenchResult

HELP = "Compare solvers: train the learned ones, measure all of them on recorded motion, write one page."


@dataclass
class BenchConfig:
    """Options of `mimicik bench`.

    Example: `mimicik bench --datasets=outputs/demo/data/ood --solvers=guided,least_squares,mink`
    """

    # Folders of LeRobot datasets to measure on, or of several of them, separated by commas.
    datasets: str = ""
    # Folder of the LeRobot dataset to train on, made by mimicik make-dataset; needed for learned rows only.
    train: str = ""
    # --policy.path: a checkpoint for the rows mimicik and mimicik_guided, which are else trained on --train; one of
    # foresight is for the rows foresight and foresight_alone.
    policy: PolicySource = field(default_factory=PolicySource)
    # The datasets' arm where they do not say: a shipped one (see `mimicik arms`) or the path of a URDF.
    arm: str = ""
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
    # or _fk0.2 (that weight of it), and with _guided after it (the prior of the guided solver).
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
    output: str = "outputs/bench"
    # File for the results as a Markdown document, such as docs/results.md; empty: none.
    markdown: str = ""
    # Where to train and evaluate (cpu, cuda, mps); empty: what LeRobot finds.
    device: str = ""
    # Number of single queries timed for the latency.
    latency_queries: int = 200


def main(argv: Sequence[str]) -> int:
    """Run the command; 1 if a training failed."""
    config = parse(BenchConfig, argv, "mimicik bench")
    with outputs.alone(config.output):
        result = run(config, command=shlex.join(["mimicik", "bench", *argv]))
    print(result.table)
    print(f"Report: {result.page}; all columns: {config.output}/table.md")
    return int(result.failed)


def run(config: BenchConfig, progress: bool = True, command: str = "") -> BenchResult:
    """Train, measure and write.

    Raises:
        ValueError: If an option does not fit, or a row was trained with other options before.
        FileNotFoundError: If a dataset or recipe does not exist.
    """
    from lerobot_mimicik.inputs import check_dataset, check_exists, datasets_in
    from lerobot_mimicik.kinematics.arms import describe_arm

    roots = datasets_in([Path(root) for root in words(config.datasets)])
    for root in roots:
        check_dataset(str(root), "--datasets")
    if config.train:
        check_dataset(config.train, "--train")
    if config.recipes:
        check_exists(config.recipes, "--recipes")
    if config.arm:
        describe_arm(config.arm)
    if progress:
        say_loading()
    from lerobot_mimicik.evaluation.bench_run import BenchOptions, run_bench

    options = BenchOptions(
        datasets=roots,
        train=Path(config.train) if config.train else None,
        policy=find_checkpoint(config.policy.path) if config.policy.path else "",
        arm=config.arm,
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
        out=Path(config.output),
        device=config.device,
        latency_queries=config.latency_queries,
        markdown=Path(config.markdown) if config.markdown else None,
        command=command,
    )
    return run_bench(options, asdict(config), progress)
