"""Weights of foresight: those in the package by their arm's name, or any checkpoint's folder. No torch, no pickle."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.foresight.features import Features
from lerobot_mimicik.foresight.network import FilterNetwork
from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm

SHIPPED = Path(__file__).with_name("shipped")
KIND = "mimicik_foresight"
"""Type of a checkpoint's policy."""
_AVERAGE = "average.network."  # the moving average: what a policy answers with
_CONFIG, _TENSORS = "config.json", "model.safetensors"
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
        features = Features(description, int(config["n_obs_steps"]))
        network = FilterNetwork(tensors, features.dof, config["objective"], float(config["t_star"]))
        network(np.zeros((1, features.dof)), np.zeros((1, features.width)))
    except KeyError as error:
        raise ValueError(f"{folder} is damaged: {error} is missing") from error
    except ValueError as error:
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
    except (SafetensorError, ValueError, OSError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    tensors = {
        name.removeprefix(_AVERAGE): value for name, value in found.items() if name.startswith(_AVERAGE)
    }
    for name, value in tensors.items():
        if not np.isfinite(value).all():
            raise ValueError(f"{path}: {name} is not finite")
    return tensors
