"""An ACT or diffusion policy in end-effector space on the simulated AIRBOT Play, with and without looking ahead.

LeRobot's `lerobot-rollout` hands a robot one pose at a time. A loop of one's own asks the policy for its chunk and tells
the robot what follows (`foresee`). Both are done here in simulated time, and the arm's measured joints compared.

    uv run --extra sim python examples/rollout_look_ahead.py outputs/act_ee
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from numpy.typing import NDArray

from robot_adapters.robots.airbot_play import AirbotPlayEE
from robot_adapters.robots.config_airbot_play import AirbotPlayEEConfig

FPS = 20


class SteppedArm(AirbotPlayEE):
    """The simulated arm, whose time passes only when it is told to."""

    def _let_time_pass(self) -> None:
        pass


class Chunks:
    """A checkpoint of LeRobot's that is asked for chunks; `mimicik wrap` has made it ready for a robot."""

    def __init__(self, path: str | Path) -> None:
        config = PreTrainedConfig.from_pretrained(path)
        config.device = "cpu"
        self.policy = get_policy_class(config.type).from_pretrained(path, config=config).eval()
        self.before, self.after = make_pre_post_processors(config, pretrained_path=str(path))
        self.used = int(config.n_action_steps)

    def __call__(self, state: list[float]) -> NDArray[np.float64]:
        """Poses and grippers (T, d) for the state of a robot in end-effector space."""
        with torch.inference_mode():
            batch = self.before({"observation.state": torch.tensor([state], dtype=torch.float32)})
            chunk = self.after(self.policy.predict_action_chunk(batch))
        return chunk[0, : self.used].double().numpy()


def drive(
    chunks: Chunks, seconds: float, look_ahead: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The arm's measured and commanded joints (T, 6) [rad] while it follows the policy."""
    gripper = chunks.policy.config.output_features["action"].shape[-1] == 8
    robot = SteppedArm(
        AirbotPlayEEConfig(id="stepped", interface="virtual", real_time=False, gripper=gripper)
    )
    robot.connect()
    names, measured, commanded, poses = list(robot.action_features), [], [], np.empty((0, 0))
    try:
        for _ in range(round(seconds * FPS)):
            observation = robot.get_observation()
            measured.append(robot.arm.read().q)
            if not len(poses):
                poses = chunks([observation[name] for name in names])
            actions = [dict(zip(names, pose.tolist(), strict=True)) for pose in poses]
            if look_ahead:
                robot.foresee(actions[1:])
            robot.send_action(actions[0])
            commanded.append(robot.ik_result.q)
            poses = poses[1:]
            robot.arm.clock.sleep(1 / FPS)
    finally:
        robot.disconnect()
    return np.array(measured), np.array(commanded)


def main(path: str | Path, seconds: float = 60.0) -> dict[str, dict[str, float]]:
    """Print and return the jerk (RMS) of the measured and of the commanded joints [rad/s^3], each way."""
    chunks = Chunks(path)
    rows = {}
    for name, look_ahead in (("a pose at a time", False), ("chunk foreseen", True)):
        joints = dict(zip(("measured", "commanded"), drive(chunks, seconds, look_ahead), strict=True))
        rows[name] = {
            which: float(np.sqrt(((np.diff(q, n=3, axis=0) * FPS**3) ** 2).mean()))
            for which, q in joints.items()
        }
        numbers = ", ".join(f"{which} {value:.2f}" for which, value in rows[name].items())
        print(f"{name}: jerk {numbers} rad/s^3")
    return rows


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(float, sys.argv[2:3]))
