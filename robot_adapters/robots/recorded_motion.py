"""A LeRobot teleoperator that plays recorded motion: demonstrations and tests without an operator."""

from __future__ import annotations

import time
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.decorators import check_if_not_connected

from lerobot_mimicik.kinematics.names import did_you_mean
from robot_adapters.robots.config_recorded_motion import RecordedMotionConfig


class RecordedMotion(Teleoperator):
    """Its action's keys are the column's names; a pose column `x y z ...` becomes `ee.x.pos ...`."""

    config_class = RecordedMotionConfig
    name = "recorded_motion"

    def __init__(self, config: RecordedMotionConfig) -> None:
        """A recording that begins to play when it is connected and asked.

        Raises:
            FileNotFoundError: `dataset_root` is no dataset; said before any robot is connected.
        """
        super().__init__(config)
        if not (Path(config.dataset_root).expanduser() / "meta" / "info.json").is_file():
            raise FileNotFoundError(
                f"dataset_root={config.dataset_root!r} is no LeRobot dataset: it has no meta/info.json"
            )
        self.config = config
        self._started: float | None = None

    @cached_property
    def _recording(self) -> tuple[list[str], np.ndarray, float]:
        """Keys, values (T, d) and frames per second.

        Raises:
            ValueError: No column or episode of that name; the message lists those that exist.
        """
        from lerobot.datasets import LeRobotDataset

        root = Path(self.config.dataset_root).expanduser()
        dataset = LeRobotDataset(f"local/{root.name}", root=root)
        features, column = dataset.meta.features, self.config.column
        if column not in features:
            raise ValueError(
                f"column {column!r} is not in {root}; it has {sorted(features)}.{did_you_mean(column, features)}"
            )
        if not 0 <= self.config.episode < dataset.meta.total_episodes:
            raise ValueError(
                f"episode {self.config.episode} is not in {root}; it has {dataset.meta.total_episodes}"
            )
        table = dataset.hf_dataset.with_format("numpy", columns=["episode_index", column])[:]
        values = table[column][table["episode_index"] == self.config.episode]
        names = features[column].get("names") or []
        keys = [name if "." in name else f"ee.{name}.pos" for name in names]
        gripper = "ee.gripper.pos" if keys[:1] == ["ee.x.pos"] else "gripper.pos"
        if self.config.gripper is not None and gripper not in keys:
            keys.append(gripper)
            values = np.concatenate([values, np.full((len(values), 1), self.config.gripper)], axis=1)
        return keys, values, float(dataset.meta.fps)

    @cached_property
    def action_features(self) -> dict[str, type]:
        """The column's names."""
        return dict.fromkeys(self._recording[0], float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether it plays."""
        return self._started is not None

    @property
    def is_calibrated(self) -> bool:
        """Always true."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def connect(self, calibrate: bool = True) -> None:
        """Read the recording; it plays from the first `get_action` on."""
        self._started = -1.0 if self._recording else None

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """The frame that is due; the last one when the recording is over."""
        keys, values, fps = self._recording
        now = time.monotonic()
        if self._started is None or self._started < 0:
            self._started = now
        frame = min(int((now - self._started) * fps), len(values) - 1)
        return dict(zip(keys, values[frame].tolist(), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Recordings feel nothing."""

    @check_if_not_connected
    def disconnect(self) -> None:
        """Stop playing."""
        self._started = None
