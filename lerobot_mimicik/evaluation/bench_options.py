"""What a benchmark is asked to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class BenchOptions:
    """What a benchmark is asked to do.

    Attributes:
        datasets: Folders of the LeRobot datasets to measure on.
        train: Folder of the LeRobot dataset to train on; None where no row is trained.
        policy: Checkpoint that the rows `mimicik` and `mimicik_guided` are measured with in place of trainings, or the
            rows `foresight` and `foresight_alone` in place of the package's weights.
        arm: A shipped arm or the path of a URDF, where the datasets do not name it.
        joint_units, target, state_joint_names: As in `Layout`; of the action too.
        train_episodes, episodes: Episodes to train and to measure on; empty: all of them.
        solvers: Rows, solvers by name and learned rows.
        modes: From `known_modes()`.
        seconds: Only the beginning of each episode, s; 0: all of it.
        plant_seconds: Only so much of each dataset in the modes plant, s; 0: all of it.
        seeds: Trainings of each learned row.
        steps: Training steps; 0: as the recipes say.
        size: Which recipes, "small" or "paper".
        recipes: Folder of the recipes; empty: the project's.
        conditioning: Of all learned rows; empty: as the recipes say.
        out: Folder for everything that is made.
        device: Where to train and evaluate; empty: what LeRobot finds.
        latency_queries: Number of single queries timed for the latency.
        markdown: File for the results as a Markdown document; None writes none.
        command: The command line, for page and document.
    """

    datasets: tuple[Path, ...]
    train: Path | None = None
    policy: str = ""
    arm: str = ""
    joint_units: str = "rad"
    target: str = "action"
    state_joint_names: tuple[str, ...] = ()
    train_episodes: tuple[int, ...] = ()
    episodes: tuple[int, ...] = ()
    solvers: tuple[str, ...] = ("mimicik", "mimicik_nofk", "mlp", "unet_diffusion", "hold")
    modes: tuple[str, ...] = ("open_loop", "closed_loop")
    seconds: float = 0.0
    plant_seconds: float = 0.0
    seeds: int = 1
    steps: int = 0
    size: str = "small"
    recipes: str = ""
    conditioning: str = ""
    out: Path = Path("outputs/bench")
    device: str = ""
    latency_queries: int = 200
    markdown: Path | None = None
    command: str = ""
