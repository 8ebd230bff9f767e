"""Work cut into parts that stay on disk: what an interrupted run finished is not done again.

Parts are numpy archives without pickles, one per batch of recordings, written to a temporary name and
renamed, so that a part which exists is whole. A manifest says what they were made from and with which
options; parts of anything else are refused.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_mimicik import outputs
from lerobot_mimicik.data.retargeting.retarget import Outcome

_MANIFEST = "manifest.json"
_ARRAYS = ("q", "target", "gripper")


class PartStore:
    """A folder of finished parts of one piece of work.

    Attributes:
        folder: Where the parts are.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any], resume: bool) -> None:
        """Open the folder for work described by `manifest` (JSON-able).

        Args:
            folder: Created if it does not exist; emptied unless `resume`, if it holds parts and nothing else.
            manifest: What the parts depend on: input, options, batch size.
            resume: Keep the parts that are there.

        Raises:
            FileExistsError: The folder is not one of parts, or holds something else too.
            ValueError: The parts that are there belong to other work; names what differs.
        """
        self.folder = folder
        manifest = json.loads(json.dumps(manifest))
        path = folder / _MANIFEST
        outputs.check_new(folder, "parts", overwrite=True)
        if resume and path.is_file():
            found = json.loads(path.read_text())
            differing = [key for key in {**found, **manifest} if found.get(key) != manifest.get(key)]
            if differing:
                raise ValueError(
                    f"{folder} holds parts of a run with other settings ({', '.join(sorted(differing))}): "
                    "give the same settings to resume it, or start again without resuming"
                )
            return
        outputs.remove(folder)
        outputs.mark(folder, "parts")
        path.write_text(json.dumps(manifest, indent=2))

    def path(self, number: int) -> Path:
        """Where part `number` is, or will be."""
        return self.folder / f"part-{number:05d}.npz"

    def missing(self, count: int) -> list[int]:
        """Which of the parts 0 .. count - 1 are not there."""
        return [number for number in range(count) if not self.path(number).is_file()]

    def remove(self) -> None:
        """Delete the folder: the work is done."""
        outputs.remove(self.folder)


def save_outcomes(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write a part: the trajectories end to end, and the rest as JSON."""
    headers = [
        {key: value for key, value in vars(outcome).items() if key not in _ARRAYS} for outcome in outcomes
    ]
    used = [outcome for outcome in outcomes if len(outcome.q)]
    arrays = {
        "headers": np.array(json.dumps(headers)),
        "frames": np.array([len(outcome.q) for outcome in outcomes]),
        "with_gripper": np.array([outcome.gripper is not None for outcome in outcomes]),
        "q": np.concatenate([outcome.q for outcome in used]) if used else np.empty((0, 0)),
        "target": np.concatenate([np.empty((0, 7)), *(outcome.target for outcome in used)]),
        "gripper": np.concatenate([np.empty(0), *(o.gripper for o in outcomes if o.gripper is not None)]),
    }
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    with temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)  # type: ignore[arg-type]
    os.replace(temporary, path)


def load_outcomes(path: Path) -> list[Outcome]:
    """Read a part that `save_outcomes` wrote."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    outcomes = [Outcome(**header) for header in json.loads(str(arrays["headers"]))]
    frames = arrays["frames"]
    ends = np.cumsum(frames)
    grip_ends = np.cumsum(np.where(arrays["with_gripper"], frames, 0))
    for outcome, count, end, grip_end, with_gripper in zip(
        outcomes, frames, ends, grip_ends, arrays["with_gripper"], strict=True
    ):
        if count:
            outcome.q, outcome.target = arrays["q"][end - count : end], arrays["target"][end - count : end]
        if with_gripper:
            outcome.gripper = arrays["gripper"][grip_end - count : grip_end]
    return outcomes


def manifest_of(**entries: Any) -> dict[str, Any]:
    """A manifest from dataclasses and plain values."""
    return {
        key: asdict(value) if hasattr(value, "__dataclass_fields__") else value
        for key, value in entries.items()
    }
