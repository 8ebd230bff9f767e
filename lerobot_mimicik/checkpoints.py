"""Checkpoints: which learned kinds there are, where one lies, and loading it, strictly."""

from __future__ import annotations

import importlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_mimicik.inputs import looks_like_path, near
from lerobot_mimicik.weights import CheckpointError

if TYPE_CHECKING:
    from lerobot_mimicik.configuration_learned import LearnedIKConfig
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


@dataclass(frozen=True)
class LearnedKind:
    """A kind of policy that this project trains; LeRobot finds its class beside its configuration.

    Attributes:
        name: What tables, solvers and benchmarks call it.
        type: What LeRobot calls it (`--policy.type`).
        configuration: The module that makes it known to LeRobot.
        recipe: File in `configs/` that trains it, with `{size}` for its sizes.
        about: What tables say of it.
    """

    name: str
    type: str
    configuration: str
    recipe: str
    about: str


# The one table of learned policies: a new one is its files and an entry here.
KINDS = (
    LearnedKind(
        "mimicik",
        "mimicik",
        "lerobot_mimicik.configuration_mimicik",
        "{size}.json",
        "The paper's policy: SuDeepDiT as a minimal iterative policy",
    ),
    LearnedKind(
        "mlp",
        "mimicik_mlp",
        "lerobot_mimicik.baselines.configuration_mlp",
        "mlp_{size}.json",
        "The paper's pure MLP, one forward pass",
    ),
    LearnedKind(
        "unet_diffusion",
        "mimicik_unet",
        "lerobot_mimicik.baselines.configuration_unet",
        "unet_{size}.json",
        "1-D UNet, DDPM with 10 steps (diffusers)",
    ),
)
# No solver by itself: it steadies what the guided one is asked for, and a trained one comes with the package.
FORESIGHT = LearnedKind(
    "foresight",
    "mimicik_foresight",
    "lerobot_mimicik.configuration_foresight",
    "foresight.json",
    "What a hand that trembles means, from its last targets",
)
FORESIGHT_SOLVERS = ("foresight", "foresight_alone")
"""Solvers that such a checkpoint is for: under guidance, and its network alone."""
_BY_TYPE = {kind.type: kind for kind in (*KINDS, FORESIGHT)}
# As tables and solvers call checkpoints: the kinds, and MimicIK trained without the FK consistency loss.
LEARNED = ("mimicik", "mimicik_nofk", *(kind.name for kind in KINDS[1:]))


def register_configurations() -> None:
    """Make every kind known to LeRobot, which knows a policy's type once its configuration is imported."""
    for kind in _BY_TYPE.values():
        importlib.import_module(kind.configuration)


def kind_of(config: LearnedIKConfig) -> str:
    """What tables call a checkpoint with this configuration, one of `LEARNED`, or `foresight`."""
    kind = _BY_TYPE[config.type].name
    return "mimicik_nofk" if kind == "mimicik" and config.fk_weight == 0 else kind


def solvers_of(kind: str) -> tuple[str, ...]:
    """The rows of tables that a checkpoint of a kind can be measured in."""
    return FORESIGHT_SOLVERS if kind == FORESIGHT.name else (kind, "mimicik_guided")


def find_checkpoint(path: str) -> str:
    """The folder of the weights, given it, a training run's checkpoint, or a run's output folder.

    Anything that is no folder is returned as it is: it may be a Hub repository.

    Raises:
        FileNotFoundError: If the folder holds no checkpoint, or the path looks like no repository either.
    """
    folder = Path(path).expanduser()
    inside = (".", "pretrained_model", "checkpoints/last/pretrained_model")
    if folder.is_dir():
        for candidate in inside:
            if (folder / candidate / "config.json").is_file():
                return str(folder / candidate)
        raise FileNotFoundError(
            f"{path} holds no checkpoint: expected config.json in it, or in {' or '.join(inside[1:])} below."
        )
    if folder.is_file():
        raise FileNotFoundError(
            f"{path} is a file, a checkpoint is a folder. A file of `mimicik export` is taken by "
            "MimicIKAdapter.from_pretrained, by ik.path of robots and commands, and as an engine."
        )
    if looks_like_path(path):
        raise FileNotFoundError(
            f"The checkpoint {path} does not exist: there is no such folder, and it does not look like a Hub "
            f"repository (user/name).{near(path)}"
        )
    return path


def load_policy(path: str, device: str | None = None) -> LearnedIKPolicy:
    """Load a policy of any learned kind from `find_checkpoint(path)`, onto a device if one is given.

    Raises:
        FileNotFoundError: If there is no checkpoint.
        CheckpointError: If its configuration or its weights are damaged.
        ValueError: If it is one of another policy, or there is no such device.
    """
    from lerobot.policies.factory import get_policy_class

    found = find_checkpoint(path)
    if device is not None:
        check_device(device)
    config = read_config(found)
    if config.type not in _BY_TYPE:
        raise ValueError(
            f"{path} is a checkpoint of type {config.type!r}; expected one of {', '.join(_BY_TYPE)}."
        )
    if device is not None:
        config.device = device
    return get_policy_class(config.type).from_pretrained(found, config=config)


def check_device(name: str) -> None:
    """Refuse a device that torch does not know, or that this machine does not have.

    Raises:
        ValueError: It names the device, and those that exist.
    """
    if not re.fullmatch(r"cpu|mps|(cuda|xpu)(:[0-9]+)?", name):
        raise ValueError(f"device={name!r}: expected cpu, cuda, cuda:N, mps or xpu.")
    if name == "cpu":
        return
    import torch
    from lerobot.utils.device_utils import is_torch_device_available

    kind, _, number = name.partition(":")
    count = torch.get_device_module(kind).device_count() if is_torch_device_available(kind) else 0
    if int(number or 0) >= count:
        raise ValueError(f"device={name!r}: torch finds {count} devices of that kind here; cpu always works.")


def read_config(found: str) -> Any:
    """The configuration in a checkpoint's folder or Hub repository, of any policy that LeRobot knows.

    Raises:
        CheckpointError: It is damaged; the message names the file.
    """
    from draccus.utils import DraccusException
    from lerobot.configs import PreTrainedConfig

    register_configurations()
    file = Path(found) / "config.json"
    if file.is_file():
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise CheckpointError(f"{file} is damaged: {error}.") from error
        if not isinstance(content, dict) or not isinstance(content.get("type"), str):
            raise CheckpointError(f"{file} is no configuration of a policy: expected an object with a type.")
    try:
        return PreTrainedConfig.from_pretrained(found)
    except (DraccusException, TypeError, AttributeError, KeyError) as error:
        raise CheckpointError(f"{file if file.is_file() else found}: {error}") from error
