"""An arm, its tool's path and a target, drawn into a scene of viser."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.arm_arrays import Array
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.shapes import Shape, drawn_shapes

if TYPE_CHECKING:
    from viser import SceneApi

Colour = tuple[int, int, int]
"""Red, green and blue from 0 to 255."""

_GREY = (0.75, 0.76, 0.78)  # of shapes without a colour of their own
_TINT = 0.35  # how much of a solver's colour the solid arm takes on
_GHOST = 0.4  # opacity
_PATH_M = 0.004  # thickness of the solid arm's path
_THINNER = 0.04  # by which a ghost is, so that it lies within the arms before it where they agree


class DrawnArm:
    """An arm of one colour, solid or a ghost, with the path of its tool."""

    def __init__(
        self, scene: SceneApi, description: ArmDescription, name: str, colour: Colour, ghost: int = 0
    ) -> None:
        """
        Args:
            scene: Where it is drawn.
            description: The arm.
            name: Of its node.
            colour: Of all of a ghost, and of its solver's in a solid arm's.
            ghost: 0 for the solid arm; others are numbered.
        """
        self._root = f"/arms/{name}"
        self._chain = array_chain(description)
        self._top = scene.add_frame(self._root, show_axes=False)
        self._bodies = [
            scene.add_frame(f"{self._root}/body{body}", show_axes=False)
            for body in range(self._chain.dof + 1)
        ]
        for number, shape in enumerate(drawn_shapes(description)):
            own = 255 * np.array(shape.colour or _GREY)
            red, green, blue = ((1 - _TINT) * own + _TINT * np.array(colour)).astype(int).tolist()
            node = f"{self._root}/body{shape.body}/shape{number}"
            if ghost:
                thinner = replace(shape, size=tuple((1 - ghost * _THINNER) * edge for edge in shape.size))
                add_shape(scene, node, thinner, colour, _GHOST)
            else:
                add_shape(scene, node, shape, (red, green, blue))
        self._path = Path(scene, f"{self._root}/path", colour, thickness=_PATH_M * (1 - 0.2 * min(ghost, 3)))

    def show(self, q: Array) -> None:
        """Put the arm to joints (dof,) and let its tool's path grow."""
        corners = [np.concatenate([np.zeros((1, 3)), np.eye(3)])] * len(self._bodies)
        for frame, moved in zip(self._bodies, self._chain.body_points(q[None], corners), strict=True):
            origin, axes = moved[0, :, 0], moved[1:, :, 0]
            frame.position = origin
            frame.wxyz = _wxyz((axes - origin).T)
        self._path.add(self._chain.pose(q[None])[0, :3])

    def forget(self) -> None:
        """Begin the path anew."""
        self._path.clear()

    def remove(self) -> None:
        """Take it out of the scene."""
        self._top.remove()


class Path:
    """A line through the last positions that it was given."""

    def __init__(
        self, scene: SceneApi, name: str, colour: Colour, length: int = 80, thickness: float = 0.003
    ) -> None:
        self._points: deque[Array] = deque(maxlen=length)
        self._lines = scene.add_line_segments(
            name, np.zeros((1, 2, 3), dtype=np.float32), colour, thickness=thickness, visible=False
        )

    def add(self, position: Array) -> None:
        """Go on to a position (3,) [m]."""
        self._points.append(np.asarray(position, dtype=np.float32))
        if len(self._points) > 1:
            points = np.array(self._points)
            self._lines.points = np.stack([points[:-1], points[1:]], axis=1)
            self._lines.visible = True

    def clear(self) -> None:
        """Begin anew."""
        self._points.clear()
        self._lines.visible = False


def add_shape(scene: SceneApi, name: str, shape: Shape, colour: Colour, opacity: float | None = None) -> None:
    """Draw one shape below the node that its name says."""
    rotation, position = shape.pose
    at: dict[str, Any] = {"wxyz": _wxyz(rotation), "position": position}
    look: dict[str, Any] = {"opacity": opacity, "cast_shadow": opacity is None}
    if shape.kind == "box":
        x, y, z = shape.size
        scene.add_box(name, colour, (x, y, z), **at, **look)
    elif shape.kind == "sphere":
        scene.add_icosphere(name, shape.size[0], colour, **at, **look)
    else:
        radius, length = shape.size
        scene.add_cylinder(name, radius, length, colour, **at, **look)
        if shape.kind == "capsule":
            for end in (-1, 1):
                offset = (0.0, 0.0, end * length / 2)
                scene.add_icosphere(f"{name}/cap{end}", radius, colour, position=offset, **look)


def wxyz_of(pose: Array) -> Array:
    """The quaternion of a pose (7,) as viser orders it."""
    return pose[[6, 3, 4, 5]]


def pose_of(position: Array, wxyz: Array) -> Array:
    """A pose (7,) x y z qx qy qz qw of viser's position and quaternion."""
    return np.concatenate([position, np.asarray(wxyz)[[1, 2, 3, 0]]])


def _wxyz(rotation: Array) -> Array:
    return Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
