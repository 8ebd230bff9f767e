"""A policy's step as an ONNX graph, and as a file that says for which arm it is and what it must answer."""

from __future__ import annotations

import hashlib
import io
import json
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from lerobot_mimicik.inference import eager
from lerobot_mimicik.inference.engine import TOLERANCE, EngineUnavailable, disagreement, example_queries
from lerobot_mimicik.inference.facts import StepFacts
from lerobot_mimicik.inference.onnx_file import FORMAT, PRODUCER, StepFile
from lerobot_mimicik.inference.step import JointStep, example_inputs

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

_OPSET = 17  # the first with layer normalisation; ONNX Runtime reads it since 1.12 (2022)
_COLUMNS = (
    "last frames, oldest first, each: joints [rad, m], T_base_tool now, asked for (x y z [m] qx qy qz qw)"
)


def graph(policy: LearnedIKPolicy) -> bytes:
    """The serialised ONNX model of a policy's step: `frames`, and `noise` where the policy draws it, to `step`.

    Raises:
        ModuleNotFoundError: The package `onnx` is not installed.
    """
    made, example = io.BytesIO(), example_inputs(policy)
    with torch.no_grad(), warnings.catch_warnings():
        # torch announces that tracing will give way to its new exporter, which needs more packages and more time.
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", torch.jit.TracerWarning)  # shapes are the same in every query
        torch.onnx.export(
            JointStep(policy, fold=True).eval(),
            example,
            made,  # type: ignore[arg-type] # a file that is open, which the older exporter takes
            dynamo=False,
            opset_version=_OPSET,
            input_names=["frames", "noise"],
            output_names=["step"],
        )
    return made.getvalue()


def write(policy: LearnedIKPolicy, path: str | Path) -> float:
    """Export a policy on the CPU to a file, which is read back and compared before it gets its name.

    Args:
        policy: Whose averaged weights go into the file.
        path: The file; one that is there is replaced.

    Returns:
        By how much the file's answers differ from the policy's [rad].

    Raises:
        EngineUnavailable: A package is not installed.
        ValueError: It differs by more than `TOLERANCE`.
    """
    try:
        import onnx
    except ModuleNotFoundError as error:
        raise EngineUnavailable(
            "onnx is not installed: uv pip install 'lerobot_policy_mimicik[onnx]'"
        ) from error
    model = onnx.load_model_from_string(graph(policy))
    model.producer_name = PRODUCER
    onnx.helper.set_model_props(model, _metadata(policy))
    path = Path(path)
    beside = path.with_name(path.name + ".writing")
    try:
        beside.write_bytes(model.SerializeToString())
        apart = disagreement(policy, StepFile.load(beside).engine)
        if not apart <= TOLERANCE:
            raise ValueError(
                f"the exported step differs from the policy's by {apart:.2e} rad, more than {TOLERANCE:g}: not written"
            )
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
    return apart


def _metadata(policy: LearnedIKPolicy) -> dict[str, str]:
    """What the file says beside its graph; `onnx_file` reads it."""
    facts, config = StepFacts.of(policy), policy.config
    reference = eager.make(policy)
    queries = [(frames, noise, reference(frames, noise)) for frames, noise in example_queries(facts)]
    relative = getattr(policy.conditioning, "relative", None)
    return {
        "mimicik": FORMAT,
        "policy_type": config.type,
        "joint_names": json.dumps(list(facts.description.joint_names)),
        "joint_lower": json.dumps(facts.lower.tolist()),
        "joint_upper": json.dumps(facts.upper.tolist()),
        "urdf_sha256": hashlib.sha256(facts.description.urdf.encode()).hexdigest(),
        "arm": facts.description.to_json(),
        "frames": f"{facts.steps} {_COLUMNS}",
        "step": "added to the last joints [rad, m], then kept within the limits",
        "history": str(facts.steps),
        "noise": json.dumps({"width": facts.width, "random": facts.random, "seed": facts.seed}),
        "step_range": json.dumps(
            None if relative is None else [relative.lower.tolist(), relative.upper.tolist()]
        ),
        "check": json.dumps([[part.tolist() for part in query] for query in queries]),
    }
