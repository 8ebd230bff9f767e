"""`mimicik make-dataset`: datasets, generated, retargeted from recorded hand motion, or made of an arm's logs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_mimicik import outputs
from lerobot_mimicik.cli.options import decimals, parse, words
from lerobot_mimicik.data.retargeting.cleaning import CleaningOptions
from lerobot_mimicik.data.retargeting.placement import PlacementOptions
from lerobot_mimicik.data.retargeting.recordings import SourceColumns
from lerobot_mimicik.data.retargeting.retarget import RetargetOptions
from lerobot_mimicik.data.writer import SPACES
from lerobot_mimicik.inputs import check_exists
from lerobot_mimicik.kinematics.names import did_you_mean

if TYPE_CHECKING:
    from lerobot_mimicik.data.joint_logs import LogSummary
    from lerobot_mimicik.data.retargeting.report import RetargetSummary
    from lerobot_mimicik.data.stress.sets import StressSummary
    from lerobot_mimicik.data.stress.tremor import RecordedMotion
    from lerobot_mimicik.data.teleoperation.synthetic import SyntheticSummary
    from lerobot_mimicik.kinematics.arms import ArmDescription

HELP = "Make a dataset: generate teleoperation, retarget recorded end-effector motion, or read an arm's logs."

SOURCES = ("synthetic", "ee", "joints", "stress")
_SYNTHETIC_TEST_SHARE = 0.15


@dataclass
class RobotOptions:
    """The arm."""

    # A shipped arm (`mimicik arms` lists them) or the path of a URDF.
    name: str = "airbot_play"
    # Link whose frame poses are given in; empty: the arm's own, else the URDF's root.
    base_link: str = ""
    # Link that carries the tool; empty: the arm's own, else the URDF's only leaf.
    tip_link: str = ""
    # Order of the joint vector, comma-separated; empty: from base to tip.
    joint_names: str = ""
    # Tool frame in the tip link: x,y,z in m, or x,y,z,roll,pitch,yaw in m and rad. AIRBOT gripper:
    # 0.1594,0,0.
    tool_offset: str = ""
    # Comfortable configuration to begin from, in the joints' order [rad, m], comma-separated; empty: the arm's own,
    # else one that is found.
    home: str = ""


@dataclass
class ColumnOptions:
    """source=ee, joints: which columns of the input mean what; usual names are found by themselves."""

    # Column of stamps.
    time: str = ""
    # Unit of the stamps: s, ms, us, ns; empty: guessed from their step.
    time_unit: str = ""
    # Frame rate of an input without stamps [Hz].
    fps: float = 0.0
    # Three columns, or one of 3-vectors; of a LeRobot dataset: the feature with the poses.
    position: str = ""
    # Unit of the positions: m, cm, mm.
    position_unit: str = "m"
    # source=joints: columns of the measured joints, in the arm's order.
    joints: str = ""
    # source=joints: columns of the commanded ones; empty: each frame aims at the next measured joints.
    commands: str = ""
    # source=joints: rad or deg; joints that slide are in m.
    joint_units: str = "rad"
    # Four columns (quaternion) or three (rotation vector), or one of such vectors.
    rotation: str = ""
    # Order of quaternion components: xyzw or wxyz.
    quaternion_order: str = "xyzw"
    # Columns that together name one recording, outermost first: person,session,episode.
    groups: str = ""
    # Columns that together name a session (splits never cut one); empty: the groups without the last.
    session: str = ""
    # Gripper width or opening, passed through as gripper.pos.
    gripper: str = ""
    # Column with a sentence on what is done.
    task: str = ""


@dataclass
class FitOptions:
    """source=ee: how recordings are repaired and made to fit the arm."""

    # Largest joint motion per frame [rad]; faster motion is slowed down.
    max_step: float = 0.1
    # Extent of the workspace box x,y,z [m]; empty: the paper's 0.43,0.40,0.23, scaled by the arm's reach.
    workspace: str = ""
    # Middle of that box in the base frame x,y,z [m]; empty: before the arm's home pose.
    centre: str = ""
    # Largest factor on recorded translations (1: never enlarge).
    max_scale: float = 1.0
    # Largest rotation away from a recording's mean orientation [rad]; larger ones are scaled down.
    max_rotation: float = PlacementOptions.max_rotation
    # Largest tilt of the mean tool orientation away from the home orientation [rad].
    max_tilt: float = PlacementOptions.max_tilt
    # Distance kept from the arm itself and the floor [m].
    clearance: float = RetargetOptions.clearance
    # Height of the floor in the base frame [m]; null: no floor.
    floor: float | None = 0.0
    # Width of the smoothing of recordings [s].
    smoothing: float = CleaningOptions.bandwidth
    # Faster steps of the recording are jumps of the tracker [m/s].
    max_speed: float = CleaningOptions.max_speed
    # Longer holes in the stamps cut a recording [s].
    max_gap: float = CleaningOptions.max_gap
    # Shorter recordings are dropped [s].
    min_duration: float = CleaningOptions.min_duration
    # Rounds of placements tried before a recording is dropped.
    attempts: int = RetargetOptions.attempts


@dataclass
class StressOptions:
    """source=stress: which sets, and how long."""

    # Of tremor-0mm, tremor-0.5mm, tremor-1mm, tremor-2mm, near-singular, out-of-reach, splices, reclutching,
    # outside-limits, workspace, separated by commas; empty: all of them.
    kinds: str = ""
    # Length of an episode [s].
    seconds: float = 30.0


_STRESS_EPISODES = 4  # of each kind


@dataclass
class MakeDatasetConfig:
    """Options of `mimicik make-dataset`.

    source=synthetic writes OUTPUT/train, OUTPUT/test (other sessions) and OUTPUT/ood (near singularities).
    source=ee retargets recordings by smooth whole-trajectory inverse kinematics and writes OUTPUT, or, with a
    test_share, OUTPUT/train and OUTPUT/test. Input: parquet or CSV (time, position, quaternion or rotation
    vector, group columns), a folder of such files, UMI-style tables (robot0_eef_pos,
    robot0_eef_rot_axis_angle), or a LeRobot dataset with poses. zarr is not read: convert it first.
    source=joints writes OUTPUT from logs of an arm's joints (parquet or CSV, a folder of such files, or a
    LeRobot dataset): time, measured joints (q1, q2, ... or the joints' names), gripper and, where --columns.commands
    names them, commanded joints.
    source=stress writes OUTPUT/KIND for each kind of stress set (see docs/stress.md), for any arm; with --input, a
    dataset of its joints, tremor is added to that motion.

    Example: `mimicik make-dataset --source=ee --input=recordings --arm=airbot_play --output=data/hand`
    """

    # synthetic: generated teleoperation; ee: retargeted end-effector recordings; joints: an arm's logs; stress:
    # motions that tell solvers apart.
    source: str = "synthetic"
    # Folder of the dataset to write.
    output: str = ""
    # source=ee, joints: file, folder or LeRobot dataset to read. source=stress: dataset whose motion shall tremble.
    input: str = ""
    robot: RobotOptions = field(default_factory=RobotOptions)
    # source=synthetic: number of episodes, train and test together. source=stress: of each kind; 0: 4, or all
    # that are recorded.
    # source=ee: first recordings only; 0: all.
    episodes: int = 0
    # Space of state and action: joints (to train MimicIK), or ee: poses (to train a policy that it serves).
    space: str = "joints"
    # Frames per second.
    fps: int = 20
    # Time constant with which measured joints follow the command [s]; null: 0.04 for synthetic, 0 for ee.
    lag: float | None = None
    # Share of the sessions for a test split; null: 0.15 for synthetic, none for ee.
    test_share: float | None = None
    # source=synthetic: also write the near-singular trajectories.
    ood: bool = True
    # source=synthetic: steady hands and exact sensors, to learn foresight from.
    clean: bool = False
    # source=synthetic: fraction of episodes that show how to leave a singularity.
    recovery: float = 400 / 6427
    # source=ee: task sentence for recordings without one.
    task: str = "follow the recorded hand motion"
    # Source of all randomness: the same seed gives the same dataset, whatever the number of workers.
    seed: int = 0
    # Processes that work in parallel.
    workers: int = 2
    # source=ee: continue a run that was interrupted.
    resume: bool = False
    # Replace a dataset that is already there.
    overwrite: bool = False
    columns: ColumnOptions = field(default_factory=ColumnOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    stress: StressOptions = field(default_factory=StressOptions)


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status."""
    config = parse(MakeDatasetConfig, _expanded(argv), "mimicik make-dataset")
    try:
        with outputs.alone(config.output) if config.output else nullcontext():
            print(run(config))
    except (ValueError, OSError) as error:
        print(f"mimicik make-dataset: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        hint = "; continue with --resume" if config.source == "ee" else ""
        print(f"mimicik make-dataset: interrupted{hint}", file=sys.stderr)
        return 130
    return 0


def run(
    config: MakeDatasetConfig, progress: bool = True
) -> SyntheticSummary | RetargetSummary | LogSummary | StressSummary:
    """Make the dataset.

    Raises:
        ValueError: An option does not fit; the message names it and what exists.
        OSError: The input does not exist, or the output does.
    """
    from lerobot_mimicik.kinematics.arms import describe_arm

    if config.source not in SOURCES:
        raise ValueError(
            f"--source must be one of {', '.join(SOURCES)}, got {config.source!r}."
            + did_you_mean(config.source, SOURCES)
        )
    if config.space not in SPACES:
        raise ValueError(
            f"--space must be one of {', '.join(SPACES)}, got {config.space!r}."
            + did_you_mean(config.space, SPACES)
        )
    if not config.output:
        raise ValueError("--output is missing: the folder of the dataset to write")
    robot = config.robot
    description = describe_arm(
        robot.name,
        robot.base_link or None,
        robot.tip_link or None,
        words(robot.joint_names) or None,
        decimals(robot.tool_offset, "--robot.tool_offset") or None,
    )
    home = decimals(robot.home, "--robot.home")
    if home or (config.source == "synthetic" and not description.home):
        from lerobot_mimicik.data.home import with_home

        description = with_home(description, home)
    if config.source == "synthetic" and not home:
        print(f"home of {robot.name}: {','.join(map(str, description.home))} (--robot.home sets another)")
    if config.source == "synthetic":
        if config.input or config.resume:
            raise ValueError("--input and --resume belong to --source=ee")
        from lerobot_mimicik.data.teleoperation.session import SyntheticConfig
        from lerobot_mimicik.data.teleoperation.synthetic import make_synthetic

        if config.episodes <= 0:
            raise ValueError(f"--episodes must be positive with --source=synthetic, got {config.episodes}")
        recording = SyntheticConfig.clean if config.clean else SyntheticConfig
        lag: dict[str, Any] = {} if config.lag is None else {"lag_s": config.lag}
        return make_synthetic(
            Path(config.output),
            config.episodes,
            description,
            seed=config.seed,
            workers=config.workers,
            test_share=_SYNTHETIC_TEST_SHARE if config.test_share is None else config.test_share,
            ood=config.ood,
            config=recording(fps=config.fps, recovery_share=config.recovery, **lag),
            progress=progress,
            overwrite=config.overwrite,
            space=config.space,
        )
    if config.source == "stress":
        return _write_stress(config, description)
    if not config.input:
        raise ValueError("--input is missing: the file, folder or LeRobot dataset to read")
    check_exists(config.input, "--input")
    if config.source == "joints":
        return _write_logs(config, description)
    from lerobot_mimicik.data.retargeting.dataset import JobOptions, retarget_dataset

    job = JobOptions(
        workers=config.workers,
        resume=config.resume,
        overwrite=config.overwrite,
        test_share=config.test_share or 0.0,
        lag_s=config.lag or 0.0,
        task=config.task,
        robot_type=_robot_type(robot),
        progress=progress,
        limit=config.episodes,
        space=config.space,
    )
    return retarget_dataset(
        config.input,
        config.output,
        description,
        _retarget_options(config),
        _source_columns(config.columns),
        job,
    )


def _write_stress(config: MakeDatasetConfig, description: ArmDescription) -> StressSummary:
    from lerobot_mimicik.data.stress.sets import KINDS, RECORDED_KINDS, make_stress

    for option in ("lag", "test_share", "resume"):
        if getattr(config, option):
            raise ValueError(f"--{option} does not belong to --source=stress")
    if config.space != "joints":
        raise ValueError(
            "--space=ee does not belong to --source=stress: these sets are to measure solvers on"
        )
    fps, recorded = _recorded_motion(config, description)
    return make_stress(
        config.output,
        description,
        kinds=words(config.stress.kinds) or (RECORDED_KINDS if recorded else KINDS),
        episodes=config.episodes or len(recorded) or _STRESS_EPISODES,
        seconds=config.stress.seconds,
        fps=fps,
        seed=config.seed,
        robot_type=_robot_type(config.robot),
        overwrite=config.overwrite,
        recorded=recorded,
        inputs=[config.input] if recorded else [],
    )


def _recorded_motion(
    config: MakeDatasetConfig, description: ArmDescription
) -> tuple[int, list[RecordedMotion]]:
    """Frame rate and recordings of the dataset --input, where there is one."""
    from lerobot_mimicik.data.stress.tremor import RecordedMotion

    if not config.input:
        return config.fps, []
    check_exists(config.input, "--input")
    import torch

    from lerobot_mimicik.evaluation.trajectories import load_trajectories
    from lerobot_mimicik.kinematics.chain import SerialArm

    found = load_trajectories(config.input, SerialArm(description, dtype=torch.float64))
    return round(found.fps), [RecordedMotion(each.q, each.target) for each in found.trajectories]


def _write_logs(config: MakeDatasetConfig, description: ArmDescription) -> LogSummary:
    from lerobot_mimicik.data.joint_logs import LogColumns, write_joint_logs

    columns = config.columns
    for option in ("episodes", "lag", "test_share", "resume"):
        if getattr(config, option):
            raise ValueError(f"--{option} does not belong to --source=joints")
    for option in ("position", "rotation"):
        if getattr(columns, option):
            raise ValueError(f"--columns.{option} does not belong to --source=joints: logs of joints only")
    return write_joint_logs(
        config.input,
        config.output,
        description,
        LogColumns(
            **_table_columns(columns),
            joints=tuple(words(columns.joints)),
            commands=tuple(words(columns.commands)),
            units=columns.joint_units,
            gripper=columns.gripper,
        ),
        fps=config.fps,
        max_gap=config.fit.max_gap,
        min_duration=config.fit.min_duration,
        robot_type=_robot_type(config.robot),
        overwrite=config.overwrite,
        space=config.space,
    )


def _robot_type(robot: RobotOptions) -> str | None:
    return None if "/" in robot.name else robot.name


def _retarget_options(config: MakeDatasetConfig) -> RetargetOptions:
    fit = config.fit
    return RetargetOptions(
        cleaning=CleaningOptions(
            fps=config.fps,
            max_speed=fit.max_speed,
            max_gap=fit.max_gap,
            min_duration=fit.min_duration,
            bandwidth=fit.smoothing,
        ),
        placement=PlacementOptions(
            workspace=decimals(fit.workspace, "--fit.workspace"),
            centre=decimals(fit.centre, "--fit.centre"),
            max_scale=fit.max_scale,
            max_rotation=fit.max_rotation,
            max_tilt=fit.max_tilt,
        ),
        max_step=fit.max_step,
        clearance=fit.clearance,
        floor=fit.floor,
        attempts=fit.attempts,
        seed=config.seed,
    )


def _source_columns(options: ColumnOptions) -> SourceColumns:
    for option in ("joints", "commands"):
        if getattr(options, option):
            raise ValueError(f"--columns.{option} belongs to --source=joints")
    return SourceColumns(
        **_table_columns(options),
        position=tuple(words(options.position)),
        position_unit=options.position_unit,
        rotation=tuple(words(options.rotation)),
        quaternion_order=options.quaternion_order,
        gripper=options.gripper,
    )


def _table_columns(options: ColumnOptions) -> dict[str, Any]:
    """What both kinds of recorded tables have."""
    return {
        "time": options.time,
        "time_unit": options.time_unit,
        "fps": options.fps,
        "groups": tuple(words(options.groups)),
        "session": tuple(words(options.session)),
        "task": options.task,
    }


def _expanded(argv: Sequence[str]) -> list[str]:
    """The command line with `--arm=NAME` and `--robot=NAME` written out as `--robot.name=NAME`."""
    return [_arm_option(argument) for argument in argv]


def _arm_option(argument: str) -> str:
    option, equals, value = argument.partition("=")
    name, dot, field_name = option.partition(".")
    if name not in ("--arm", "--robot"):
        return argument
    return f"--robot.{field_name if dot else 'name'}{equals}{value}"
