"""Weights from files, loaded strictly: a policy runs with what was trained or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor, nn


class CheckpointError(ValueError):
    """A checkpoint that is damaged, or whose weights are not those of its configuration."""


def read_tensors(path: str | Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file, on the CPU.

    Raises:
        CheckpointError: If it is missing, truncated or no such file.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not Path(path).is_file():
        raise CheckpointError(f"{path} is missing: the checkpoint has no weights.")
    try:
        return load_file(path)
    except (SafetensorError, ValueError, OSError) as error:
        raise CheckpointError(f"{path} is damaged: {error}.") from error


def check_tensors(path: str | Path) -> None:
    """See that a safetensors file is whole, without reading its numbers.

    Raises:
        CheckpointError: If it is truncated or no such file.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np"):
            pass
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is damaged: {error}.") from error


def load_tensors(module: nn.Module, tensors: Mapping[str, Tensor], where: str | Path) -> None:
    """Fill a module from the tensors of a checkpoint, all of them and no others.

    Args:
        module: Built from the checkpoint's configuration.
        tensors: By the names of `module.state_dict()`.
        where: The file they are from, for messages.

    Raises:
        CheckpointError: If a tensor is missing, surplus, of another shape or kind, or not finite, or if a range
            of training values is empty; it names the tensor.
    """
    from lerobot_mimicik.normalisation import MinMax

    expected = module.state_dict()
    problems = [
        *(f"{name} is missing" for name in expected if name not in tensors),
        *(f"{name} does not belong to its configuration" for name in tensors if name not in expected),
    ]
    for name in expected.keys() & tensors.keys():
        ours, found = expected[name], tensors[name]
        if ours.shape != found.shape:
            problems.append(f"{name} has shape {tuple(found.shape)}, expected {tuple(ours.shape)}")
        elif ours.is_floating_point() != found.is_floating_point():
            problems.append(f"{name} holds {found.dtype}, expected {ours.dtype}")
        elif not found.isfinite().all():
            problems.append(f"{name} is not finite")
    ranges = [] if problems else [n for n, part in module.named_modules() if isinstance(part, MinMax)]
    for name in ranges:
        if (tensors[f"{name}.lower"] > tensors[f"{name}.upper"]).any():
            problems.append(f"{name}.lower exceeds {name}.upper")
    if problems:
        more = f", and {len(problems) - 3} more faults" if len(problems) > 3 else ""
        raise CheckpointError(f"{where}: {'; '.join(problems[:3])}{more}.")
    module.load_state_dict(tensors)
