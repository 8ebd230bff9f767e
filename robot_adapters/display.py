"""A deployment in rerun: the arm, targets, its tool, joint steps, limits and safety events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from lerobot_mimicik import outputs
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.poses import pose_distance
from lerobot_mimicik.kinematics.shapes import drawn_shapes, outline
from robot_adapters.adapter import MimicIKAdapter

if TYPE_CHECKING:
    from robot_adapters.arm import ArmState, CommandResult

_TRAIL = 200  # frames of the path that stay in sight
_FRAME = np.concatenate([np.zeros((1, 3)), np.eye(3)])  # origin and axes of a body
_GREY = (0.75, 0.78, 0.82)  # of shapes without a colour of their own
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
        rerun.send_blueprint(_layout())
        rerun.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._chain = array_chain(adapter.description)
        self._log_shapes()

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
        self._move_arm(state.q)
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

    def _log_shapes(self) -> None:
        """The shapes of the URDF, each on its body; meshes are not read, bones stand for them."""
        rr = self._rerun
        for number, shape in enumerate(drawn_shapes(self._adapter.description)):
            points = outline(shape)
            out = points - points.mean(axis=0)
            rr.log(
                f"world/arm/body{shape.body}/shape{number}",
                rr.Mesh3D(
                    vertex_positions=points,
                    triangle_indices=ConvexHull(points).simplices,
                    vertex_normals=out / np.linalg.norm(out, axis=1, keepdims=True),
                    albedo_factor=[*(shape.colour or _GREY), 1.0],
                ),
                static=True,
            )

    def _move_arm(self, q: NDArray[np.float64]) -> None:
        """Put the bodies to joints (dof,) [rad, m]."""
        rr = self._rerun
        for body, moved in enumerate(self._chain.body_points(q[None], [_FRAME] * (self._chain.dof + 1))):
            origin, axes = moved[0, :, 0], moved[1:, :, 0]
            rr.log(f"world/arm/body{body}", rr.Transform3D(translation=origin, mat3x3=(axes - origin).T))


def _layout() -> Any:
    """What the viewer opens with: the arm, beside it steps, errors and joints over time, events below."""
    from rerun import blueprint as rrb

    curves = [
        rrb.TimeSeriesView(origin=origin, name=name)
        for origin, name in (
            ("steps", "joint steps [rad]"),
            ("error", "error [mm, deg]"),
            ("joints", "joints [rad]"),
        )
    ]
    left = rrb.Vertical(
        rrb.Spatial3DView(origin="world", name="arm"),
        rrb.TextLogView(origin="events", name="events"),
        row_shares=[4, 1],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*curves), column_shares=[3, 2]), collapse_panels=True
    )
