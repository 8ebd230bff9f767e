"""Which numbers of a dataset column are arm joints, and which are passed through (a gripper)."""

import re
from collections.abc import Sequence


def _canonical(name: str) -> str:
    """Column and joint names compare without suffix, case and separators: `joint_1.pos` is `joint1`."""
    return re.sub(r"[^a-z0-9]", "", name.lower().removesuffix(".pos"))


def flat_names(names: object) -> list[str] | None:
    """Names of a LeRobot feature as a flat list; some datasets nest them under one key (`{"motors": [...]}`)."""
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, (list, tuple)) else None


def joint_columns(
    feature: str,
    names: Sequence[str] | None,
    width: int,
    joint_names: Sequence[str],
    requested: Sequence[str] | None = None,
) -> list[int]:
    """Positions of the arm's joints in a dataset column.

    They are found by the requested names; without these by the URDF's joint names; and where none of the
    names is known, the joints are taken to come first, in order, as in most datasets.

    Args:
        feature: name of the column, for messages.
        names: the column's element names, or None where the dataset gives none.
        width: number of elements.
        joint_names: the arm's joints, in order.
        requested: element names that the user gave, in joint order.

    Returns:
        One index for each joint.

    Raises:
        ValueError: if a requested name does not exist or the column is too narrow.
    """
    if requested is not None:
        if len(requested) != len(joint_names):
            raise ValueError(
                f"{feature}: {len(requested)} names {list(requested)} for {len(joint_names)} joints"
            )
        missing = [name for name in requested if name not in (names or ())]
        if missing:
            raise ValueError(f"{feature} has no elements {missing}; it has {list(names or ())}")
        return [list(names or ()).index(name) for name in requested]
    canonical = [_canonical(name) for name in names or ()]
    wanted = [_canonical(name) for name in joint_names]
    if all(name in canonical for name in wanted):
        return [canonical.index(name) for name in wanted]
    if width < len(joint_names):
        raise ValueError(
            f"{feature} has {width} elements {list(names or ())}, fewer than the arm's {len(joint_names)} "
            f"joints {list(joint_names)}"
        )
    return list(range(len(joint_names)))
