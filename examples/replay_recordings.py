"""End-effector recordings through stock `lerobot-replay` onto simulated arms: how exact and smooth the joint commands are.

A circle, a line along which the tool turns by 90 degrees, and the motion of a hand, scaled into reach, all around the
arm's home. `mimicik_ee` stands before the simulated arm and, where placo is installed (extra `bench`), LeRobot's
`RobotKinematics` in its place, called as LeRobot's own example of replaying does, from its last answer on. Run it
with `uv run python examples/replay_recordings.py` and the names of arms, if not all. The hand's motion is generated;
`--hand=FILE` adds one that was recorded (any input of `mimicik make-dataset --source=ee`), the longest of the file.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
from lerobot.datasets import LeRobotDataset
from lerobot.robots.config import RobotConfig
from lerobot.scripts import lerobot_replay
from scipy.spatial.transform import Rotation

from lerobot_mimicik.cli.arms import reach
from lerobot_mimicik.data.retargeting.cleaning import CleaningOptions, clean_recording
from lerobot_mimicik.data.retargeting.recordings import load_recordings
from lerobot_mimicik.data.teleoperation.hand_motion import Goal, HandPath, sample_style
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.kinematics.poses import compose, pose_distance
from robot_adapters.robots.config_mimicik_sim import MimicIKSimConfig
from robot_adapters.robots.mimicik_sim import MimicIKSim

ARMS = ("so101", "piper", "panda", "airbot_play")
FPS = 20  # of the simulated arm; the recording is played as fast as the computer can
KEYS = [f"ee.{name}.pos" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
HAND_ROOM = (
    0.3  # side of the cube around home that a hand's motion is scaled into, in parts of the arm's reach
)
HAND_TURN = 0.5  # rad from home's orientation that its turns are scaled to
Array = np.ndarray


@RobotConfig.register_subclass("observed_sim")
@dataclass
class ObservedSimConfig(MimicIKSimConfig):
    """A simulated arm that keeps what it is told."""


class ObservedSim(MimicIKSim):
    """A simulated arm that keeps what it is told."""

    config_class = ObservedSimConfig
    commands: list[Array] = []  # noqa: RUF012 - of the last arm, which the command makes and drops

    def connect(self, calibrate: bool = True) -> None:
        ObservedSim.commands = []
        super().connect(calibrate)

    def send_action(self, action: dict) -> dict:
        sent = super().send_action(action)
        ObservedSim.commands.append(self.servos.target)
        return sent


@RobotConfig.register_subclass("lerobot_ik_sim")
@dataclass
class LeRobotIKSimConfig(ObservedSimConfig):
    """The same arm behind LeRobot's inverse kinematics."""


class LeRobotIKSim(ObservedSim):
    """Poses to joints by `RobotKinematics`, from its own last answer on."""

    config_class = LeRobotIKSimConfig
    told = False  # whether it is told where the arm is; else its first answer starts from all joints at zero

    def connect(self, calibrate: bool = True) -> None:
        from lerobot.model.kinematics import RobotKinematics

        super().connect(calibrate)
        with tempfile.TemporaryDirectory() as folder:
            urdf = Path(folder) / "arm.urdf"
            urdf.write_text(self.description.urdf)
            names = list(self.description.joint_names)
            self._ik = RobotKinematics(str(urdf), self.description.tip_link, names)
        self._q = np.degrees(self.servos.measure())
        if self.told:
            self._ik.forward_kinematics(self._q)

    def send_action(self, action: dict) -> dict:
        pose = np.array([float(action[key]) for key in KEYS])
        target = np.eye(4)
        target[:3, :3], target[:3, 3] = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
        self._q = self._ik.inverse_kinematics(self._q, target)
        return super().send_action(dict(zip(self.joint_keys, self._q, strict=True)))


@RobotConfig.register_subclass("lerobot_ik_told_sim")
@dataclass
class LeRobotIKToldSimConfig(ObservedSimConfig):
    """The same, but that its forward kinematics are asked for first, which LeRobot's example does not do."""


class LeRobotIKToldSim(LeRobotIKSim):
    """Poses to joints by `RobotKinematics`, which knows where the arm is."""

    config_class = LeRobotIKToldSimConfig
    told = True


def generated_hand(frames: int) -> Array:
    """Poses (T, 7) of a hand that reaches from place to place and turns, in its own frame."""
    rng = np.random.default_rng(0)
    path = HandPath(np.zeros(6), sample_style(rng), rng, begin_s=0.5)
    while path.now < frames / FPS:
        path.move(Goal(rng.uniform(-1, 1, 6) * [0.15, 0.15, 0.1, 0.4, 0.4, 0.4]))
    motion = path.sample(np.arange(frames) / FPS)
    return np.hstack([motion[:, :3], Rotation.from_rotvec(motion[:, 3:]).as_quat()])


def recorded_hand(source: str) -> Array:
    """Poses (T, 7) of the longest recording of a file or folder, at the arm's rate."""
    return clean_recording(max(load_recordings(source), key=len), CleaningOptions(fps=FPS)).pose


def placed(hand: Array, arm: str) -> Array:
    """A hand's motion (T, 7) from home on, scaled into reach where it is larger."""
    description = describe_arm(arm)
    home = point_chain(description).pose(np.array(description.home))
    way = hand[:, :3] - hand[0, :3]
    turns = (Rotation.from_quat(hand[:, 3:]) * Rotation.from_quat(hand[0, 3:]).inv()).as_rotvec()
    way *= min(1.0, HAND_ROOM / 2 * reach(description) / np.abs(way).max())
    turns *= min(1.0, HAND_TURN / np.linalg.norm(turns, axis=1).max())
    turned = Rotation.from_rotvec(turns) * Rotation.from_quat(home[3:])
    return np.hstack([home[:3] + way, turned.as_quat()])


def recordings(arm: str, frames: int, hand: str | None = None) -> dict[str, Array]:
    """Target poses (T, 7) of each recording: from home to home, from home to the end of a line, and hands'."""
    description = describe_arm(arm)
    chain = point_chain(description)
    home = chain.pose(np.array(description.home))
    part = np.linspace(0.0, 1.0, frames)
    way = part**3 * (10 + part * (6 * part - 15))  # from rest to rest
    circle = np.tile(home, (frames, 1))
    circle[:, 1] += 0.04 * np.sin(2 * np.pi * way)
    circle[:, 2] += 0.04 * (1 - np.cos(2 * np.pi * way))
    # About the axis of the last joint, seen from the tool, to where it has room: every arm can turn about that one.
    last = description.joints()[-1]
    nudged = np.array(description.home)
    nudged[-1] += 1e-3 if last.upper - nudged[-1] > nudged[-1] - last.lower + 1e-3 else -1e-3
    turned = Rotation.from_quat(home[3:]).inv() * Rotation.from_quat(chain.pose(nudged)[3:])
    axis = turned.as_rotvec() / np.linalg.norm(turned.as_rotvec())
    turns = np.zeros((frames, 7))
    turns[:, 3:] = Rotation.from_rotvec(np.pi / 2 * way[:, None] * axis).as_quat()
    line = compose(home, turns)
    line[:, 1] += 0.1 * way
    hands = {"hand, generated": generated_hand(frames)} | (
        {"hand, recorded": recorded_hand(hand)} if hand else {}
    )
    return {"circle": circle, "line, 90 degrees": line} | {
        name: placed(each, arm) for name, each in hands.items()
    }


def write(poses: Array, root: Path, fps: int = 1000) -> None:
    """A LeRobot dataset of one episode whose actions are poses; `lerobot-replay` waits 1 / `fps` for each."""
    features = {"action": {"dtype": "float32", "shape": (7,), "names": KEYS}}
    dataset = LeRobotDataset.create("local/poses", fps, features=features, root=root, use_videos=False)
    for pose in poses:
        dataset.add_frame({"action": pose.astype(np.float32), "task": "follow"})
    dataset.save_episode()
    dataset.finalize()


def replay(root: Path, *robot: str) -> Array:
    """Joint commands [rad] (T, dof) of stock `lerobot-replay`."""
    options = [
        f"--dataset.root={root}",
        "--dataset.repo_id=local/poses",
        "--dataset.episode=0",
        "--play_sounds=false",
    ]
    with mock.patch.object(sys, "argv", ["lerobot-replay", *robot, *options]):
        lerobot_replay.main()
    return np.array(ObservedSim.commands)


def main(arms: tuple[str, ...] = ARMS, frames: int = 200, hand: str | None = None) -> list[dict]:
    """Replay everything; one row for each arm, recording and solver."""
    rows = []
    for arm in arms:
        chain = point_chain(describe_arm(arm))
        sim = ["real_time=false", f"fps={FPS}", f"arm={arm}", "gripper=false"]
        robots = {"mimicik_ee": ["--robot.type=mimicik_ee", "--robot.arm.type=observed_sim"]}
        robots["mimicik_ee"] += [f"--robot.arm.{each}" for each in sim]
        if importlib.util.find_spec("placo") is not None:
            for kind, name in (("lerobot_ik_sim", ""), ("lerobot_ik_told_sim", ", told its start")):
                options = [f"--robot.{each}" for each in sim]
                robots[f"LeRobot's RobotKinematics{name}"] = [f"--robot.type={kind}", *options]
        for name, poses in recordings(arm, frames, hand).items():
            with tempfile.TemporaryDirectory() as folder:
                write(poses, Path(folder) / "poses")
                for solver, robot in robots.items():
                    q = replay(Path(folder) / "poses", *robot)
                    errors = np.array(
                        [pose_distance(chain.pose(each), pose) for each, pose in zip(q, poses, strict=True)]
                    )
                    jerk = np.diff(q, n=3, axis=0) * FPS**3
                    rows.append(
                        {
                            "arm": arm,
                            "recording": name,
                            "robot": solver,
                            "mean_mm": errors[:, 0].mean() * 1e3,
                            "max_mm": errors[:, 0].max() * 1e3,
                            "mean_degrees": np.degrees(errors[:, 1].mean()),
                            "largest_step_rad": np.abs(np.diff(q, axis=0)).max(),
                            "jerk_rad_s3": np.sqrt((jerk**2).mean()),
                        }
                    )
    return rows


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    lines = [
        "| arm | recording | robot | mean mm | max mm | mean degrees | largest step rad | jerk rad/s³ |",
        "|---|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['arm']} | {row['recording']} | {row['robot']} | {row['mean_mm']:.3f} | {row['max_mm']:.3f} | "
            f"{row['mean_degrees']:.2f} | {row['largest_step_rad']:.3f} | {row['jerk_rad_s3']:.2f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("arms", nargs="*", default=ARMS)
    parser.add_argument(
        "--hand", help="recorded motion of a hand: a table, a folder of them, or a LeRobot dataset"
    )
    asked = parser.parse_args()
    print(table(main(tuple(asked.arms), hand=asked.hand)))
