"""What computes a policy's step: the engines by name, fastest first. No torch is imported here.

A new engine is a module with `make(policy)`, which raises `EngineUnavailable` where it cannot run, and a line in
`ENGINES`.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_mimicik.inference.engine import TOLERANCE, Engine, EngineUnavailable, disagreement
from lerobot_mimicik.inference.facts import StepFacts
from lerobot_mimicik.inference.onnx_file import StepFile
from lerobot_mimicik.kinematics.names import did_you_mean

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

ENGINES = {
    "onnx": "lerobot_mimicik.inference.onnx_engine",
    "traced": "lerobot_mimicik.inference.traced",
    "eager": "lerobot_mimicik.inference.eager",
}
AUTO = "auto"


def check_engine(name: str) -> str:
    """The name itself; ValueError for one that is no engine and no file, with those that are."""
    known = [AUTO, *ENGINES]
    if name not in known and not _is_file(name):
        raise ValueError(
            f"engine={name!r}: expected one of {', '.join(known)}, or a file of `mimicik export`."
            + did_you_mean(name, known)
        )
    return name


def _is_file(name: str) -> bool:
    return name.endswith(".onnx") and Path(name).is_file()


def make_engine(policy: LearnedIKPolicy, name: str = AUTO) -> tuple[str, Engine]:
    """An engine for a policy with its present weights, and its name.

    Args:
        policy: On the device where it shall run.
        name: One of `ENGINES`, a file of `mimicik export`, or `auto`: the fastest that is installed and agrees with the
            policy.

    Raises:
        ValueError: There is no such engine, or the one asked for disagrees by more than `TOLERANCE`.
        EngineUnavailable: The one asked for cannot run here.
    """
    check_engine(name)
    if name != AUTO:
        engine = _from_file(policy, name) if _is_file(name) else _made(policy, name)
        apart = disagreement(policy, engine)
        if not apart <= TOLERANCE:
            raise ValueError(
                f"engine={name!r} disagrees with the policy by {apart:.2e} rad, more than {TOLERANCE:g}: "
                f"make it again from this checkpoint, or take engine={AUTO!r}."
            )
        return name, engine
    for each in ENGINES:
        try:
            engine = _made(policy, each)
        except EngineUnavailable:
            continue
        if disagreement(policy, engine) <= TOLERANCE:
            return each, engine
    raise ValueError(f"none of the engines {', '.join(ENGINES)} agrees with the policy.")


def _made(policy: LearnedIKPolicy, name: str) -> Engine:
    return importlib.import_module(ENGINES[name]).make(policy)


def _from_file(policy: LearnedIKPolicy, path: str) -> Engine:
    """The engine in an exported file; ValueError where it is another arm's or looks at another history."""
    file, facts = StepFile.load(path), StepFacts.of(policy)
    for what, theirs, own in (
        ("joints", file.facts.description.joint_names, facts.description.joint_names),
        ("frames of history", file.facts.steps, facts.steps),
        ("random numbers", file.facts.width, facts.width),
    ):
        if theirs != own:
            raise ValueError(
                f"engine={path!r} was made from another policy: its {what} are {theirs}, expected {own}"
            )
    return file.engine
