"""The options of `mimicik make-dataset`."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot_mimicik.data.retargeting.cleaning import CleaningOptions
from lerobot_mimicik.data.retargeting.placement import PlacementOptions
from lerobot_mimicik.data.retargeting.retarget import RetargetOptions


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
