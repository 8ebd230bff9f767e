"""An exported policy: one ONNX file that knows its arm, and answers of the policy that it is held against.

Neither torch nor LeRobot is imported here, nor the package `onnx`: ONNX Runtime is enough to run a file.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.inference.engine import TOLERANCE, Engine
from lerobot_mimicik.inference.facts import StepFacts
from lerobot_mimicik.inference.onnx_session import engine_of, session
from lerobot_mimicik.kinematics.arms import ArmDescription

Array = NDArray[np.float64]

SUFFIX = ".onnx"
FORMAT = "1"
"""Of the metadata; another number is refused."""
PRODUCER = "mimicik export"
"""Stands at the beginning of every file, which tells it from others."""


@dataclass(frozen=True)
class StepFile:
    """What a file holds.

    Attributes:
        policy_type: What LeRobot calls the policy that it was made from.
        facts: What a query needs to know of the policy beside its step.
        step_range: Smallest and largest pose step (6,) [m, rad] that training saw; None where the policy was not
            conditioned on them.
        engine: Computes the step.
    """

    policy_type: str
    facts: StepFacts
    step_range: tuple[Array, Array] | None
    engine: Engine

    @classmethod
    def load(cls, path: str | Path) -> StepFile:
        """Read a file and compare its answers with those of the policy that it was made from.

        Raises:
            FileNotFoundError: There is no such file.
            EngineUnavailable: ONNX Runtime is not installed.
            ValueError: It is damaged or was not made by `mimicik export`, or here it answers otherwise than the policy by
                more than `TOLERANCE`.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path} does not exist: expected a file of `mimicik export`")
        try:
            made = session(Path(path))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        told = made.get_modelmeta().custom_metadata_map
        if told.get("mimicik") != FORMAT:
            raise ValueError(
                f"{path} was not made by `mimicik export` of this version: its metadata has mimicik="
                f"{told.get('mimicik')!r}, expected {FORMAT!r}; export the checkpoint again"
            )
        try:
            found = cls(told["policy_type"], _facts(told), _step_range(told), engine_of(made))
            apart = max(
                float(np.abs(found.engine(frames, noise) - step).max())
                for frames, noise, step in _checks(told, found.facts)
            )
        except Exception as error:  # of JSON, of URDF, of shapes: whatever is wrong with what the file says
            raise ValueError(f"{path} is damaged: {type(error).__name__}: {error}") from error
        if not apart <= TOLERANCE:
            raise ValueError(
                f"{path} disagrees with the policy that it was made from by {apart:.2e} rad, more than {TOLERANCE:g}: "
                "it was changed, or ONNX Runtime computes otherwise here; export the checkpoint again"
            )
        return found


def _facts(told: dict[str, str]) -> StepFacts:
    description = ArmDescription.from_json(told["arm"])
    if hashlib.sha256(description.urdf.encode()).hexdigest() != told["urdf_sha256"]:
        raise ValueError("the URDF in it is not the one whose hash it has")
    noise: dict[str, Any] = json.loads(told["noise"])
    return StepFacts(
        description,
        np.array(json.loads(told["joint_lower"]), dtype=float),
        np.array(json.loads(told["joint_upper"]), dtype=float),
        int(told["history"]),
        int(noise["width"]),
        bool(noise["random"]),
        int(noise["seed"]),
    )


def _step_range(told: dict[str, str]) -> tuple[Array, Array] | None:
    bounds = json.loads(told["step_range"])
    return None if bounds is None else (np.array(bounds[0], dtype=float), np.array(bounds[1], dtype=float))


def _checks(told: dict[str, str], facts: StepFacts) -> list[tuple[Array, NDArray[np.float32], Array]]:
    """Frames, noise and the policy's steps."""
    dof = len(facts.description.joint_names)
    checks: list[tuple[Array, NDArray[np.float32], Array]] = [
        (
            np.array(frames, dtype=float).reshape(facts.steps, dof + 14),
            np.array(noise, dtype=np.float32).reshape(1, facts.width),
            np.array(step, dtype=float).reshape(dof),
        )
        for frames, noise, step in json.loads(told["check"])
    ]
    if not checks:
        raise ValueError("it has no answers of the policy")
    return checks
