"""Forward kinematics and Jacobian of one configuration, in plain floats.

What a control loop asks: one configuration at a time, where numpy takes ten times longer to start its operations
than to do them. Built from an `ArrayChain`, with which it agrees to rounding (there is a test).
"""

from __future__ import annotations

import functools
import math

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain

_Frame = tuple[float, ...]
"""Columns x, y, z of a rotation and a position: 12 numbers."""


class PointChain:
    """Kinematics of the arm of a description, one configuration at a time."""

    def __init__(self, description: ArmDescription) -> None:
        chain = array_chain(description)
        self.dof = chain.dof
        self._steps = [
            (_flat(*step), column, prismatic)
            for step, column, prismatic in zip(chain.steps, chain.columns, chain.prismatic, strict=True)
        ]
        self._tool = _flat(*chain.tool)

    def pose(self, q: np.ndarray) -> np.ndarray:
        """`T_base_tool` (7,), x y z (m) qx qy qz qw with qw >= 0, of joints (dof,) [rad, or m].

        Raises:
            ValueError: Another number of joints.
        """
        frame = _follow(self._walk(q)[-1], self._tool)
        return np.array([*frame[9:], *_quaternion(frame)])

    def rotation_position_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tool rotation (3, 3), position (3,) and geometric Jacobian (6, dof), linear rows first.

        Raises:
            ValueError: Another number of joints.
        """
        frames = self._walk(q)
        tool = _follow(frames[-1], self._tool)
        px, py, pz = tool[9:]
        columns: list[tuple[float, ...]] = [()] * self.dof
        for (_, column, prismatic), frame in zip(self._steps, frames, strict=True):
            x, y, z = frame[6:9]
            if prismatic:
                columns[column] = (x, y, z, 0.0, 0.0, 0.0)
                continue
            ax, ay, az = px - frame[9], py - frame[10], pz - frame[11]
            columns[column] = (y * az - z * ay, z * ax - x * az, x * ay - y * ax, x, y, z)
        return np.array(tool[:9]).reshape(3, 3).T, np.array(tool[9:]), np.array(columns).T

    def _walk(self, q: np.ndarray) -> list[_Frame]:
        """The frames that the joints move, each with its axis as z."""
        values = np.asarray(q, dtype=float).tolist()
        if len(values) != self.dof:
            raise ValueError(f"expected {self.dof} joints, got {len(values)}")
        frame: _Frame = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        frames: list[_Frame] = []
        for step, column, prismatic in self._steps:
            ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz = _follow(frame, step)
            value = values[column]
            if prismatic:
                frame = (
                    ax,
                    ay,
                    az,
                    bx,
                    by,
                    bz,
                    cx,
                    cy,
                    cz,
                    px + cx * value,
                    py + cy * value,
                    pz + cz * value,
                )
            else:
                s, c = math.sin(value), math.cos(value)
                frame = (
                    *(ax * c + bx * s, ay * c + by * s, az * c + bz * s),
                    *(bx * c - ax * s, by * c - ay * s, bz * c - az * s),
                    *(cx, cy, cz, px, py, pz),
                )
            frames.append(frame)
        return frames


@functools.lru_cache(maxsize=8)
def point_chain(description: ArmDescription) -> PointChain:
    """The chain of a description, built once per process."""
    return PointChain(description)


def _flat(rotation: np.ndarray, position: np.ndarray) -> _Frame:
    return (*rotation.T.ravel().tolist(), *position.tolist())


def _follow(a: _Frame, b: _Frame) -> _Frame:
    """The frame `a`, followed by the constant one `b`."""
    ax, ay, az, bx, by, bz, cx, cy, cz, px, py, pz = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11 = b
    return (
        ax * b0 + bx * b1 + cx * b2,
        ay * b0 + by * b1 + cy * b2,
        az * b0 + bz * b1 + cz * b2,
        ax * b3 + bx * b4 + cx * b5,
        ay * b3 + by * b4 + cy * b5,
        az * b3 + bz * b4 + cz * b5,
        ax * b6 + bx * b7 + cx * b8,
        ay * b6 + by * b7 + cy * b8,
        az * b6 + bz * b7 + cz * b8,
        ax * b9 + bx * b10 + cx * b11 + px,
        ay * b9 + by * b10 + cy * b11 + py,
        az * b9 + bz * b10 + cz * b11 + pz,
    )


def _quaternion(frame: _Frame) -> tuple[float, float, float, float]:
    """Unit quaternion xyzw with w >= 0: products with its largest component, normalised (Shepperd 1978)."""
    xx, yx, zx, xy, yy, zy, xz, yz, zz = frame[:9]
    largest = max(
        (1 + xx - yy - zz, (1 + xx - yy - zz, xy + yx, xz + zx, zy - yz)),
        (1 - xx + yy - zz, (xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx)),
        (1 - xx - yy + zz, (xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy)),
        (1 + xx + yy + zz, (zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz)),
    )[1]
    norm = math.copysign(math.sqrt(sum(value * value for value in largest)), largest[3])
    x, y, z, w = largest
    return x / norm, y / norm, z / norm, w / norm
