"""Weights of foresight: those in the package by their arm's name, or any checkpoint's folder. No torch, no pickle."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.foresight.features import Features
from lerobot_mimicik.foresight.network import FilterNetwork, lags
from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm

SHIPPED = Path(__file__).with_name("shipped")
KIND = "mimicik_foresight"
"""Type of a checkpoint's policy."""
_AVERAGE = "average.network."  # the moving average: what a policy answers with
_CONFIG, _TENSORS = "config.json", "model.safetensors"
_MOST_TARGETS = 100
"""Of a history, as in every policy's configuration: what a damaged one asks for must not take the memory."""
_TRAINED = ("network.", "average.", "delta.", "conditioning.", "noise_seed", "training_step")
"""What the names of a trained checkpoint's tensors begin with."""
_KEPT = (
    "type", "urdf", "base_link", "tip_link", "joint_names", "tool_offset", "n_obs_steps", "objective", "t_star",
)  # fmt: skip


@dataclass(frozen=True)
class ForesightWeights:
    """What `Foresight` runs.

    Attributes:
        description: The arm that they were trained for.
        features: What the network is told.
        network: The network.
    """

    description: ArmDescription
    features: Features
    network: FilterNetwork


def shipped() -> tuple[str, ...]:
    """Arms whose weights are in the package, sorted."""
    return tuple(sorted(path.parent.name for path in SHIPPED.glob(f"*/{_CONFIG}")))


def is_foresight(folder: str | Path) -> bool:
    """Whether a folder holds a checkpoint of this kind."""
    try:
        return json.loads((Path(folder) / _CONFIG).read_text())["type"] == KIND
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def load_weights(where: str | Path) -> ForesightWeights:
    """Weights by an arm's name, or of a checkpoint's folder.

    Raises:
        FileNotFoundError: If there is neither.
        ValueError: If the folder holds another policy's checkpoint, or a damaged one.
    """
    folder = SHIPPED / str(where) if str(where) in shipped() else Path(where)
    if not (folder / _CONFIG).is_file():
        raise FileNotFoundError(
            f"no foresight weights {str(where)!r}: expected a checkpoint's folder, or one of {', '.join(shipped())}"
        )
    if not is_foresight(folder):
        raise ValueError(f"{folder} holds no checkpoint of {KIND}")
    config: dict[str, Any] = json.loads((folder / _CONFIG).read_text())
    tensors = _tensors(folder / _TENSORS)
    try:
        description = describe_arm(
            config["urdf"],
            base_link=config["base_link"],
            tip_link=config["tip_link"],
            joint_names=config["joint_names"],
            tool_offset=config["tool_offset"] or None,
        )
        if str(where) in shipped():  # a checkpoint keeps no home
            description = replace(description, home=describe_arm(str(where)).home)
        history, t_star = config["n_obs_steps"], float(config["t_star"])
        if not isinstance(history, int) or history > _MOST_TARGETS:
            raise ValueError(f"n_obs_steps={history!r}: expected a whole number, at most {_MOST_TARGETS}")
        if not 0 < t_star <= 1:
            raise ValueError(f"t_star={t_star}: expected more than 0, at most 1")
        features = Features(description, history)
        _check_shapes(tensors, features)
        network = FilterNetwork(tensors, features.dof, config["objective"], t_star)
    except KeyError as error:
        raise ValueError(f"{folder} is damaged: {error} is missing") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{folder}: {error}") from error
    return ForesightWeights(description, features, network)


def pack(checkpoint: str | Path, folder: str | Path) -> Path:
    """Write what a checkpoint's averaged network needs, in half precision, as it is shipped; the weights' file.

    Args:
        checkpoint: Folder of a foresight checkpoint.
        folder: Where to write; made if need be.

    Raises:
        ValueError: If it is no foresight checkpoint.
    """
    from safetensors.numpy import save_file

    if not is_foresight(checkpoint):
        raise ValueError(f"{checkpoint} holds no checkpoint of {KIND}")
    config = json.loads((Path(checkpoint) / _CONFIG).read_text())
    tensors = _tensors(Path(checkpoint) / _TENSORS)
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    (out / _CONFIG).write_text(json.dumps({key: config[key] for key in _KEPT}, indent=1) + "\n")
    halves = {f"{_AVERAGE}{name}": value.astype(np.float16) for name, value in tensors.items()}
    # What scales observations spans many orders of magnitude.
    halves |= {f"{_AVERAGE}{name}": tensors[name].astype(np.float32) for name in ("mean", "scale")}
    save_file(halves, out / _TENSORS)
    return out / _TENSORS


def _tensors(path: Path) -> dict[str, NDArray[Any]]:
    """The averaged network's tensors by their own names. ValueError for a file that holds none."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    if not path.is_file():
        raise ValueError(f"{path} is missing: the checkpoint has no weights")
    try:
        found = load_file(path)
    except (SafetensorError, ValueError, TypeError, OSError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    for name, value in found.items():
        if not name.startswith(_TRAINED):
            raise ValueError(f"{path}: {name} does not belong to a checkpoint of {KIND}")
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise ValueError(f"{path}: {name} is not finite")
    return {name.removeprefix(_AVERAGE): value for name, value in found.items() if name.startswith(_AVERAGE)}


def _check_shapes(tensors: Mapping[str, NDArray[Any]], features: Features) -> None:
    """ValueError that names the tensors which are not those of a network for these features, of whatever hidden width."""
    hidden = next(
        (len(value) for name, value in tensors.items() if name == "layers.0.bias" and value.ndim), 0
    )
    layers = max(sum(name.endswith(".weight") for name in tensors), 2)
    last = features.dof * (lags(features.history) + 1)
    widths = [features.width + features.dof + 2, *[hidden] * (layers - 1), last]
    expected: dict[str, tuple[int, ...]] = {"mean": (features.width,), "scale": (features.width,)}
    for number, (before, after) in enumerate(pairwise(widths)):
        expected |= {
            f"layers.{2 * number}.weight": (after, before),
            f"layers.{2 * number}.bias": (after,),
        }
    problems = [
        *(f"{name} is missing" for name in expected if name not in tensors),
        *(f"{name} does not belong to its configuration" for name in tensors if name not in expected),
    ]
    for name in sorted(expected.keys() & tensors.keys()):
        found = tensors[name]
        if found.shape != expected[name]:
            problems.append(f"{name} has shape {found.shape}, expected {expected[name]}")
        elif found.dtype.kind != "f":
            problems.append(f"{name} holds {found.dtype}, expected floats")
        elif name == "scale" and not (found > 0).all():
            problems.append("scale is not positive")
    if problems:
        more = f", and {len(problems) - 3} more faults" if len(problems) > 3 else ""
        raise ValueError(f"{_TENSORS}: {'; '.join(problems[:3])}{more}")
