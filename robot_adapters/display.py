"""A deployment in rerun: targets, the arm's tool, joint steps, limits and safety events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik import outputs
from lerobot_mimicik.kinematics.poses import pose_distance
from robot_adapters.adapter import MimicIKAdapter

if TYPE_CHECKING:
    from robot_adapters.arm import ArmState, CommandResult

_TRAIL = 200  # frames of the path that stay in sight
_NAME = "mimicik_deploy"  # of the recording in rerun, which stands at the beginning of its file too


def check_recording(path: str) -> None:
    """See that a recording may be written to `path`.

    Raises:
        FileExistsError: A file is there that is no recording of a deployment.
    """
    outputs.check_file(path, "--display_file", _NAME.encode())


class RerunDisplay:
    """Shows each frame of a deployment; pass `frame` to `drive` as a watcher."""

    def __init__(self, adapter: MimicIKAdapter, fps: float, save: str | None = None) -> None:
        """Opens rerun's viewer, or writes a recording to `save`.

        Raises:
            ModuleNotFoundError: Without rerun; the message says how to install it.
            FileExistsError: `save` is a file that is no recording of a deployment.
        """
        try:
            import rerun
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "--display needs rerun: uv pip install 'lerobot_policy_mimicik[scripts]'"
            ) from error
        self._rerun: Any = rerun
        self._adapter, self._fps = adapter, fps
        self._paths: dict[str, list[NDArray[np.float64]]] = {"target": [], "tool": []}
        self._before: NDArray[np.float64] | None = None
        rerun.init(_NAME, spawn=save is None)
        if save is not None:
            check_recording(save)
            rerun.save(save)
        rerun.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def frame(
        self,
        number: int,
        target: NDArray[np.float64],
        state: ArmState,
        command: NDArray[np.float64],
        result: CommandResult,
    ) -> None:
        """Shows one frame."""
        rr = self._rerun
        rr.set_time("frame", sequence=number)
        rr.set_time("time", duration=number / self._fps)
        tool = self._adapter.forward(state.q)
        for name, pose, colour in (("target", target, (230, 120, 20)), ("tool", tool, (30, 110, 220))):
            path = self._paths[name]
            path.append(pose[:3])
            del path[:-_TRAIL]
            rr.log(f"world/{name}", rr.Transform3D(translation=pose[:3], quaternion=pose[3:]))
            rr.log(f"world/{name}_path", rr.LineStrips3D([np.array(path)], colors=[colour]))
        distance, angle = pose_distance(tool, target)
        rr.log("error/position_mm", rr.Scalars(distance * 1e3))
        rr.log("error/rotation_deg", rr.Scalars(np.degrees(angle)))
        before = result.q_sent if self._before is None else self._before
        self._before = result.q_sent
        for name, q, step in zip(
            self._adapter.joint_names, state.q, np.abs(result.q_sent - before), strict=True
        ):
            rr.log(f"joints/{name}", rr.Scalars(q))
            rr.log(f"steps/{name}", rr.Scalars(step))
        rr.log("steps/limit", rr.Scalars(0.1))
        for event in result.events:
            rr.log("events", rr.TextLog(event.message, level="WARN"))
