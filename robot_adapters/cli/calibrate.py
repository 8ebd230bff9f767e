"""`mimicik calibrate`: how a robot's joints differ from its URDF's, measured, shown and kept beside its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from lerobot_mimicik.cli.options import parse

if TYPE_CHECKING:
    from robot_adapters.calibration import Observation, OffsetFit
    from robot_adapters.robots.inner_arm import InnerArm

HELP = "Measure the offsets between a LeRobot robot's joints and its URDF, for --robot.type=mimicik_ee."
_READINGS = 20  # observations of one posture that are averaged


@dataclass
class CalibrateConfig:
    """Options of `mimicik calibrate`; the robot is named by LeRobot's own, --robot.type=..., --robot.id=..., and so on.

    Without a recording, the arm is brought by hand to postures of its URDF (mimicik play shows them).
    """

    # A shipped arm's name or a URDF; empty: known by the robot's type.
    arm_description: str = ""
    # The robot's joints in the description's order, without .pos; empty: found by their names.
    joints: list[str] = field(default_factory=list)
    # Units of the robot's joints: deg, rad, normalised; auto: as the robot says.
    joint_units: str = "auto"
    # Which arm of a robot with two: left or right.
    side: str = ""
    # Postures to hold, one after another: home, rest, zero.
    postures: list[str] = field(default_factory=lambda: ["home"])
    # JSON file of observations in place of holding: a list of {"joints": {"NAME.pos": ...}, and "held": {"NAME": degrees}
    # or "position": [x, y, z] of the tool, m}.
    recording: str = ""
    # Show what is found, and keep nothing.
    dry_run: bool = False


def main(argv: Sequence[str]) -> int:
    """Measure, show and keep the offsets; status 1 where the observations do not determine a joint."""
    own = [word for word in argv if not word.startswith("--robot.")]
    config = parse(CalibrateConfig, own, "mimicik calibrate")
    robot = _robot([word for word in argv if word.startswith("--robot.")])
    from lerobot_mimicik.outputs import check_file
    from robot_adapters.calibration import fit_offsets
    from robot_adapters.robots.inner_arm import InnerArm, sides_of
    from robot_adapters.robots.joint_offsets import MARK, write_offsets

    prefix = f"{config.side}_" if config.side else ""
    if prefix not in sides_of(robot):
        sides = [side.removesuffix("_") for side in sides_of(robot) if side]
        raise ValueError(
            f"--side={config.side}: expected {' or '.join(sides) if sides else 'none: it has one arm'}"
        )
    arm = InnerArm(robot, prefix, config.arm_description, config.joints, config.joint_units, calibrated=False)
    if arm.offsets_path is not None and not config.dry_run:
        check_file(arm.offsets_path, "the offsets", MARK)
    known = _recorded(arm, config.recording) if config.recording else _held(robot, arm, config.postures)
    fit = fit_offsets(arm.description, known)
    _show(arm, fit)
    if arm.offsets_path is None:
        raise ValueError(f"{arm.robot_type} has no folder for its calibration: the offsets cannot be kept")
    if config.dry_run:
        print("Nothing was kept (--dry_run).")
    elif not fit.determined.all():
        print("Nothing was kept: hold other postures, or record positions in which these joints differ.")
        return 1
    else:
        write_offsets(arm.offsets_path, arm.description.joint_names, fit.offsets)
        print(f"Kept in {arm.offsets_path}; --robot.type=mimicik_ee uses them from now on.")
    return 0


def _robot(options: list[str]) -> Any:
    """The robot that LeRobot's options name."""
    if not any(word.startswith("--robot.type=") for word in options):
        raise ValueError(
            "which robot? --robot.type=so101_follower --robot.port=... --robot.id=..., as LeRobot has it"
        )
    # LeRobot's own command knows all of LeRobot's robots by its imports.
    import lerobot.scripts.lerobot_replay  # noqa: F401
    from lerobot.robots.utils import make_robot_from_config
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    from robot_adapters.robots.config_mimicik_ee import parse_joint_robot

    return make_robot_from_config(parse_joint_robot(options, "mimicik calibrate"))


def _recorded(arm: InnerArm, path: str) -> list[Observation]:
    from robot_adapters.calibration import read_observations

    found = read_observations(path, arm.description.joint_names)
    observations = []
    for number, (reported, each) in enumerate(found):
        try:
            observations.append(replace(each, joints=arm.joints(reported)))
        except KeyError as error:
            raise ValueError(f"{path}, entry {number}: {error.args[0]}") from error
    return observations


def _held(robot: Any, arm: InnerArm, postures: Sequence[str]) -> list[Observation]:
    """What the robot reports in postures that its user brings it to."""
    import numpy as np

    from robot_adapters.calibration import Observation

    targets = {name: _posture(arm, name) for name in postures}
    robot.connect()
    try:
        release = getattr(getattr(arm.part, "bus", None), "disable_torque", None)
        if release is not None:
            _ask("The arm will be let go. Hold it, then press Enter. ")
            release()
        observations = []
        for name, target in targets.items():
            degrees = ", ".join(
                f"{joint} {value:.1f}"
                for joint, value in zip(arm.description.joint_names, np.degrees(target), strict=True)
            )
            _ask(f"Bring the arm to {name} ({degrees} degrees) and hold it there, then press Enter. ")
            readings = [arm.joints(robot.get_observation()) for _ in range(_READINGS)]
            observations.append(Observation(np.mean(readings, axis=0), held=target))
        return observations
    finally:
        robot.disconnect()


def _ask(what: str) -> None:
    try:
        input(what)
    except EOFError as error:
        raise RuntimeError(
            "nobody can press Enter here: run it in a terminal, or give --recording=FILE.json"
        ) from error


def _posture(arm: InnerArm, name: str) -> Any:
    import numpy as np

    from lerobot_mimicik.kinematics.arms import describe_arm
    from lerobot_mimicik.kinematics.shipped import SHIPPED

    postures: dict[str, Any] = {"zero": np.zeros(len(arm.description.joint_names))}
    if arm.description.home:
        postures["home"] = np.array(arm.description.home)
    for shipped in SHIPPED.values():
        if describe_arm(shipped.name).urdf == arm.description.urdf:
            postures["rest"] = np.array(shipped.rest)
    if name not in postures:
        raise ValueError(
            f"--postures: there is no {name!r} of this arm; it has {', '.join(sorted(postures))}"
        )
    return postures[name]


def _show(arm: InnerArm, fit: OffsetFit) -> None:
    import numpy as np

    print(f"{'joint':<20}{'offset':>12}{'left (rms)':>12}")
    for name, offset, left, known in zip(
        arm.description.joint_names,
        np.degrees(fit.offsets),
        np.degrees(fit.joints_left),
        fit.determined,
        strict=True,
    ):
        rest = "-" if np.isnan(left) else f"{left:.2f} deg"
        print(f"{name:<20}{f'{offset:.2f} deg' if known else 'not known':>12}{rest:>12}")
    if not np.isnan(fit.before):
        print(
            f"Positions of the tool: {fit.before * 1e3:.1f} mm off without, {fit.after * 1e3:.1f} mm with the offsets."
        )
