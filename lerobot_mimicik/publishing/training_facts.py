"""What a checkpoint remembers of the data that it was trained on, in a file of its own beside the weights.

LeRobot's `train_config.json` names the dataset; how large it was and what kind of motion it held would be lost with it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_mimicik.kinematics.arms import ARM_FILE

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

FACTS_NAME = "training_data.json"
TRAIN_CONFIG_NAME = "train_config.json"

_UNKNOWN = "Who recorded it, and whether on a robot, is not known here."
# What a file of `make-dataset` in the dataset says of its motion, the first that is there.
_KINDS = (
    (
        "meta/retarget_report.json",
        "Recorded end-effector motion; its joints were computed by retargeting and are synthetic.",
    ),
    ("meta/joint_log.json", "Joints recorded on a real arm."),
    (ARM_FILE, "Generated teleoperation: motion and joints are synthetic, and no robot was involved."),
)


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
        motion: What the data was, in a sentence.
    """

    dataset: str | None = None
    episodes: int | None = None
    frames: int | None = None
    fps: float | None = None
    batch_size: int | None = None
    seed: int | None = None
    motion: str | None = None

    @classmethod
    def of_dataset(cls, meta: LeRobotDatasetMetadata) -> TrainingFacts:
        """What a dataset's files tell."""
        root = Path(meta.root)
        motion = next((told for file, told in _KINDS if (root / file).is_file()), _UNKNOWN)
        return cls(meta.repo_id, meta.total_episodes, meta.total_frames, float(meta.fps), motion=motion)

    @classmethod
    def of_checkpoint(cls, folder: str | Path) -> TrainingFacts:
        """What the files beside a checkpoint's weights tell."""
        folder = Path(folder)
        known = {
            name: value for name, value in _read(folder / FACTS_NAME).items() if name in cls.__annotations__
        }
        settings = _read(folder / TRAIN_CONFIG_NAME)
        facts = cls(**known)
        return replace(
            facts,
            dataset=facts.dataset or (settings.get("dataset") or {}).get("repo_id"),
            batch_size=settings.get("batch_size"),
            seed=settings.get("seed"),
        )

    def save(self, folder: str | Path) -> None:
        """Write them beside the weights."""
        (Path(folder) / FACTS_NAME).write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")


def _read(file: Path) -> dict[str, Any]:
    if not file.is_file():
        return {}
    found = json.loads(file.read_text(encoding="utf-8"))
    return found if isinstance(found, dict) else {}
