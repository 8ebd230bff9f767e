"""`mimicik make-dataset`: datasets, generated, retargeted from recorded hand motion, or made of an arm's logs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_mimicik import outputs
from lerobot_mimicik.cli.make_dataset_options import ColumnOptions, MakeDatasetConfig, RobotOptions
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
_STRESS_EPISODES = 4  # of each kind


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
