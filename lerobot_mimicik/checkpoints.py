"""Checkpoints: which learned kinds there are, where one lies, and loading it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_mimicik.configuration_learned import LearnedIKConfig
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

# What tables call a checkpoint, by its policy's type.
_KINDS = {"mimicik": "mimicik", "mimicik_mlp": "mlp", "mimicik_unet": "unet_diffusion"}
LEARNED = ("mimicik", "mimicik_nofk", "mlp", "unet_diffusion")


def kind_of(config: LearnedIKConfig) -> str:
    """What tables call a checkpoint with this configuration, one of ``LEARNED``."""
    kind = _KINDS[config.type]
    return "mimicik_nofk" if kind == "mimicik" and config.fk_weight == 0 else kind


def find_checkpoint(path: str) -> str:
    """The folder of the weights, given it, a training run's checkpoint, or a run's output folder.

    Anything that is no folder is returned as it is: it may be a Hub repository.

    Raises:
        FileNotFoundError: If the folder holds no checkpoint, or the path looks like no repository either.
    """
    folder = Path(path)
    inside = (".", "pretrained_model", "checkpoints/last/pretrained_model")
    if folder.is_dir():
        for candidate in inside:
            if (folder / candidate / "config.json").is_file():
                return str(folder / candidate)
        raise FileNotFoundError(
            f"{path} holds no checkpoint: expected config.json in it, or in {' or '.join(inside[1:])} below."
        )
    if path.startswith((".", "/", "~")) or path.count("/") != 1:
        raise FileNotFoundError(
            f"The checkpoint {path} does not exist, and this is no Hub repository (user/name)."
        )
    return path


def load_policy(path: str, device: str | None = None) -> LearnedIKPolicy:
    """Load a policy of any learned kind from ``find_checkpoint(path)``, onto a device if one is given.

    Raises:
        FileNotFoundError: If there is no checkpoint.
        ValueError: If it is one of another policy.
    """
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    # LeRobot knows a policy's type once its configuration is imported.
    import lerobot_mimicik.baselines.configuration_mlp
    import lerobot_mimicik.baselines.configuration_unet
    import lerobot_mimicik.configuration_mimicik  # noqa: F401

    found = find_checkpoint(path)
    config = PreTrainedConfig.from_pretrained(found)
    if config.type not in _KINDS:
        raise ValueError(
            f"{path} is a checkpoint of type {config.type!r}; expected one of {', '.join(_KINDS)}."
        )
    if device is not None:
        config.device = device
    return get_policy_class(config.type).from_pretrained(found, config=config)
