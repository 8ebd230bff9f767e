"""The step in ONNX Runtime, exported in memory. No torch is imported before it is made."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lerobot_mimicik.inference.engine import EngineUnavailable
from lerobot_mimicik.inference.onnx_session import REMEDY, engine_of, session

if TYPE_CHECKING:
    from lerobot_mimicik.inference.engine import Engine
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


def make(policy: LearnedIKPolicy) -> Engine:
    """The policy's step with its weights at construction time.

    Raises:
        EngineUnavailable: ONNX Runtime or the exporter's package is not installed, or the policy is not on the CPU.
    """
    if policy.delta.lower.device.type != "cpu":
        raise EngineUnavailable(
            f"ONNX Runtime runs on the CPU here, the policy is on {policy.delta.lower.device}"
        )
    try:
        import onnx  # noqa: F401 - torch's exporter needs it
        import onnxruntime  # noqa: F401 - looked for before seconds go into the export
    except ModuleNotFoundError as error:
        raise EngineUnavailable(f"{error.name} is not installed: {REMEDY}") from error
    from lerobot_mimicik.inference.onnx_export import graph

    return engine_of(session(graph(policy)))
