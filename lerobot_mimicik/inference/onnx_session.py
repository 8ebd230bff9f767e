"""ONNX Runtime on one core of the CPU: a model as an engine. No torch is imported here."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_mimicik.inference.engine import EngineUnavailable

if TYPE_CHECKING:
    from lerobot_mimicik.inference.engine import Array, Engine

REMEDY = "uv pip install 'lerobot_policy_mimicik[onnx]'; to run an exported file, onnxruntime is enough"


def session(model: bytes | Path) -> Any:
    """An `onnxruntime.InferenceSession` of a file or its content, on one thread.

    Raises:
        EngineUnavailable: ONNX Runtime is not installed.
        ValueError: It is no ONNX model, or one that this version does not run.
    """
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise EngineUnavailable(f"{error.name} is not installed: {REMEDY}") from error
    options = onnxruntime.SessionOptions()
    # Matrices times single vectors: more threads wait for each other, and the control loop beside them for all.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(
            model if isinstance(model, bytes) else str(model), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # its classes have no common base of their own
        raise ValueError(f"ONNX Runtime {onnxruntime.__version__} cannot run it: {error}") from error


def engine_of(made: Any) -> Engine:
    """The engine that a session is; a graph that draws nothing has no input for noise."""
    names = {each.name for each in made.get_inputs()}
    output = [made.get_outputs()[0].name]

    def run(frames: Array, noise: Array) -> Array:
        given = {"frames": frames, "noise": noise}
        return made.run(output, {name: given[name] for name in names})[0]

    return run
