"""Which numbers of a dataset column are arm joints, and which are passed through (a gripper)."""

import re
from collections.abc import Sequence


def canonical_name(name: str) -> str:
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
    option: str = "--policy.state_joint_names",
) -> list[int]:
    """Positions of the arm's joints in a dataset column.

    They are found by the requested names, without these by the URDF's joint names; never by their position,
    unless the request is for positions.

    Args:
        feature: Name of the column, for messages.
        names: The column's element names, or None where the dataset gives none.
        width: Number of elements.
        joint_names: The arm's joints, in order.
        requested: Element names that the user gave, in joint order, or positions such as `"0"`.
        option: What the user gives them by, for messages.

    Returns:
        One index for each joint.

    Raises:
        ValueError: If a requested name does not exist, a joint is not found or the column is too narrow.
    """
    given = list(names or ())
    if requested is not None:
        if len(requested) != len(joint_names):
            raise ValueError(
                f"{feature}: {len(requested)} names {list(requested)} for {len(joint_names)} joints"
            )
        positions = {name: i for i, name in enumerate(given)}
        positions |= {str(i): i for i in range(width) if str(i) not in positions}
        missing = [name for name in requested if name not in positions]
        if missing:
            raise ValueError(f"{feature} has no elements {missing}; it has {given or width}")
        return [positions[name] for name in requested]
    canonical = [canonical_name(name) for name in given]
    wanted = [canonical_name(name) for name in joint_names]
    if all(name in canonical for name in wanted):
        return [canonical.index(name) for name in wanted]
    if width < len(joint_names):
        raise ValueError(
            f"{feature} has {width} elements {given}, fewer than the arm's {len(joint_names)} "
            f"joints {list(joint_names)}: is it another arm's? --policy.urdf says which"
        )
    example = [str(i) for i in range(len(joint_names))] if not given else given[: len(joint_names)]
    raise ValueError(
        f"{feature} has {f'the elements {given}' if given else f'{width} elements without names'}; the arm's "
        f"joints are {list(joint_names)}. If it is another arm's dataset, name the arm: --policy.urdf=...; if only "
        f"the names differ, give them in joint order: {option}=[{','.join(example)}]"
    )
