"""Arm descriptions: what is needed to build a `SerialArm`, and the arms that are shipped with the package.

A description holds the URDF as text, so that a checkpoint or a dataset that stores one needs no other file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib import resources
from pathlib import Path

from lerobot_mimicik.kinematics.names import did_you_mean, listed
from lerobot_mimicik.kinematics.shipped import SHIPPED
from lerobot_mimicik.kinematics.urdf import Joint, Urdf, UrdfError, is_urdf_text, read_urdf


@dataclass(frozen=True)
class ArmDescription:
    """A serial arm: a chain of a URDF, the order of its joints and the tool at its end.

    Attributes:
        urdf: URDF text.
        base_link: The link whose frame poses are given in.
        tip_link: The link that carries the tool.
        joint_names: The movable joints between base and tip, in the order of the joint vector q.
        tool_offset: Pose of the tool frame in the tip link: empty (the tip itself), xyz [m], or xyz and rpy
            [rad].
        home: A comfortable joint configuration [rad, m], in the order of `joint_names`, or empty.
    """

    urdf: str
    base_link: str
    tip_link: str
    joint_names: tuple[str, ...]
    tool_offset: tuple[float, ...] = ()
    home: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        # JSON and command lines bring lists.
        object.__setattr__(self, "joint_names", tuple(self.joint_names))
        object.__setattr__(self, "tool_offset", tuple(float(value) for value in self.tool_offset))
        object.__setattr__(self, "home", tuple(float(value) for value in self.home))
        if len(self.tool_offset) not in (0, 3, 6):
            raise ValueError(
                f"tool_offset {self.tool_offset} has {len(self.tool_offset)} numbers; expected none, "
                "3 (xyz in m) or 6 (xyz in m, rpy in rad)"
            )
        if self.home and len(self.home) != len(self.joint_names):
            raise ValueError(
                f"home has {len(self.home)} values for {len(self.joint_names)} joints "
                f"({listed(self.joint_names)})"
            )

    def chain(self) -> tuple[Joint, ...]:
        """All joints from base to tip, fixed ones included, in that order; errors as `Urdf.serial_chain`.

        Raises:
            UrdfError: Also when `joint_names` is not a permutation of the chain's movable joints.
        """
        path = read_urdf(self.urdf).serial_chain(self.base_link, self.tip_link)
        _check_joint_names(self.joint_names, path, self.base_link, self.tip_link)
        return path

    def joints(self) -> tuple[Joint, ...]:
        """The movable joints in the order of `joint_names`."""
        by_name = {joint.name: joint for joint in self.chain()}
        return tuple(by_name[name] for name in self.joint_names)

    def to_json(self) -> str:
        """The description as JSON text; `from_json` reads it back."""
        return json.dumps(asdict(self), indent=2)

    @classmethod
    def from_json(cls, text: str) -> ArmDescription:
        """Read what `to_json` wrote.

        Raises:
            ValueError: Not JSON, an entry is missing, or one is not known.
        """
        values = json.loads(text)
        if not isinstance(values, Mapping):
            raise ValueError(f"an arm description is a JSON object, found {type(values).__name__}")
        known = [field.name for field in fields(cls)]
        unknown = [key for key in values if key not in known]
        missing = [key for key in known[:4] if key not in values]
        if unknown or missing:
            raise ValueError(
                f"arm description with unknown entries {listed(unknown)} and missing entries "
                f"{listed(missing)}; its entries are {listed(known)}"
            )
        return cls(**values)


ARM_FILE = "meta/arm.json"
"""Where a dataset that this project wrote says for which arm it is."""


def arm_of_dataset(root: str | Path) -> ArmDescription | None:
    """The arm that the dataset in a folder was written for; None where it does not say.

    Raises:
        ValueError: Its file is damaged.
    """
    path = Path(root) / ARM_FILE
    if not path.is_file():
        return None
    try:
        description = ArmDescription.from_json(path.read_text(encoding="utf-8"))
        description.chain()
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} describes no arm: {error}") from error
    return description


SHIPPED_ARMS: tuple[str, ...] = tuple(SHIPPED)
"""Names that `describe_arm` knows."""


def describe_arm(
    name_or_path: str | Path,
    base_link: str | None = None,
    tip_link: str | None = None,
    joint_names: Sequence[str] | None = None,
    tool_offset: Sequence[float] | None = None,
) -> ArmDescription:
    """Describe a shipped arm, or any serial chain of a URDF.

    Args:
        name_or_path: One of `SHIPPED_ARMS`, a path to a URDF, or URDF text (it starts with `<`).
        base_link: Default: the shipped arm's, else the URDF's root.
        tip_link: Default: the shipped arm's, else the only leaf below the base.
        joint_names: Order of the joint vector; default: from base to tip.
        tool_offset: Pose of the tool frame in the tip link: xyz [m], or xyz and rpy [rad]; default: none.

    Raises:
        UrdfError: An arm, file, link or joint that does not exist (the message lists those that do), or a
            chain that is no serial arm. It is a ValueError.
    """
    shipped = SHIPPED.get(str(name_or_path))
    urdf = _shipped_urdf(str(name_or_path)) if shipped else _any_urdf(name_or_path)
    base = base_link or (shipped.base_link if shipped else urdf.root)
    tip = tip_link or (shipped.tip_link if shipped else None)
    path = urdf.serial_chain(base, tip)
    movable = tuple(joint.name for joint in path if joint.movable)
    names = movable if joint_names is None else tuple(joint_names)
    _check_joint_names(names, path, base, path[-1].child)
    home: tuple[float, ...] = ()
    if shipped and (base, path[-1].child) == (shipped.base_link, shipped.tip_link):
        home = tuple(shipped.home[movable.index(name)] for name in names)
    return ArmDescription(urdf.text, base, path[-1].child, names, tuple(tool_offset or ()), home)


def _shipped_urdf(name: str) -> Urdf:
    folder = resources.files("lerobot_mimicik.kinematics.robots")
    return read_urdf(folder.joinpath(f"{name}.urdf").read_text(encoding="utf-8"))


def _any_urdf(source: str | Path) -> Urdf:
    if not is_urdf_text(source) and not Path(source).expanduser().is_file():
        raise UrdfError(
            f"{str(source)!r} is neither a shipped arm ({listed(SHIPPED_ARMS)}) nor a URDF file."
            + did_you_mean(str(source), SHIPPED_ARMS)
        )
    return read_urdf(source)


def _check_joint_names(names: Sequence[str], path: Sequence[Joint], base: str, tip: str) -> None:
    movable = [joint.name for joint in path if joint.movable]
    unknown = [name for name in names if name not in movable]
    missing = [name for name in movable if name not in names]
    if unknown or missing or len(set(names)) != len(names):
        raise UrdfError(
            f"joint names ({listed(names)}) are not an order of the movable joints between {base!r} and "
            f"{tip!r} ({listed(movable)}): unknown {listed(unknown)}, missing {listed(missing)}"
            + ("" if len(set(names)) == len(names) else ", some repeated")
        )
