"""`mimicik arms`: the arms that are shipped with the package, or what a URDF holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_mimicik.cli.options import parse
from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.plausibility import joint_limits
from lerobot_mimicik.kinematics.shipped import SHIPPED, ShippedArm

HELP = "List the shipped arms (joints, reach, LeRobot robot types), or show one arm or URDF."

# Where the reach is looked for: random configurations, and values of one joint.
_SAMPLES, _LINE = 1000, 64


@dataclass
class ArmsConfig:
    """Options of `mimicik arms`, e.g. `mimicik arms --arm=so101`."""

    # A shipped arm, or the path of a URDF; empty: all that are shipped.
    arm: str = ""
    # Last link of the arm, where the URDF has several ends; empty: the shipped arm's, or its only one.
    tip_link: str = ""


def main(argv: Sequence[str]) -> int:
    """Run the command."""
    config = parse(ArmsConfig, argv, "mimicik arms")
    if config.arm:
        print(_one(describe_arm(config.arm, tip_link=config.tip_link or None), config.arm))
    else:
        print(_all())
    return 0


def reach(description: ArmDescription) -> float:
    """Furthest that the tool gets from the first joint within the limits [m].

    The best of a random sample, then one joint at a time.
    """
    chain, (lower, upper) = array_chain(description), joint_limits(description)
    lower, upper = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    first = chain.steps[0][1]
    q = np.random.default_rng(0).uniform(lower, upper, (_SAMPLES, len(lower)))
    found = 0.0
    for joint in [-1, *range(len(lower))] * 3:
        if joint >= 0:
            q = np.repeat(q[:1], _LINE, axis=0)
            q[1:, joint] = np.linspace(lower[joint], upper[joint], _LINE - 1)
        distance = np.linalg.norm(chain.forward(q)[1] - first, axis=1)
        best = int(np.argmax(distance))
        q, found = q[best : best + 1], float(distance[best])
    return found


def _all() -> str:
    rows = [("name", "arm", "joints", "reach", "LeRobot robot types")]
    for arm in SHIPPED.values():
        description = describe_arm(arm.name)
        rows.append(
            (
                arm.name,
                arm.title,
                str(len(description.joint_names)),
                f"{reach(description):.2f} m",
                _types(arm),
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    lines = [
        "  ".join([*(text.ljust(w) for text, w in zip(row, widths, strict=False)), row[4]]) for row in rows
    ]
    return "\n".join(
        [*lines, "", "mimicik arms --arm=NAME shows limits, home and rest; a URDF's path works too."]
    )


def _types(arm: ShippedArm | None) -> str:
    return ", ".join(arm.robot_types if arm else ()) or "-"


def _one(description: ArmDescription, name: str) -> str:
    arm = SHIPPED.get(name)
    lines = [
        f"{arm.title if arm else name}: {description.base_link} to {description.tip_link}, "
        f"{len(description.joint_names)} joints, reach {reach(description):.2f} m",
        f"LeRobot robot types: {_types(arm)}",
        "",
    ]
    # A shipped arm with another tip has no home or rest of its own.
    home = description.home
    rest = arm.rest if arm and home else ()
    rows = [("joint", "lower", "upper", "speed", "home", "rest")]
    for index, joint in enumerate(description.joints()):
        unit = "m" if joint.type == "prismatic" else "rad"
        rows.append(
            (
                f"{joint.name} [{unit}]",
                f"{joint.lower:.3f}",
                f"{joint.upper:.3f}",
                f"{joint.velocity:.2f}/s",
                f"{home[index]:.3f}" if home else "-",
                f"{rest[index]:.3f}" if rest else "-",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(6)]
    for row in rows:
        cells = [
            row[0].ljust(widths[0]),
            *(text.rjust(w) for text, w in zip(row[1:], widths[1:], strict=True)),
        ]
        lines.append("  ".join(cells))
    if not home:
        lines += ["", "No home is given: commands that need one find it."]
    return "\n".join(lines)
