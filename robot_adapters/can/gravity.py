"""Gravity torques of a serial arm from the masses in its URDF, in plain numpy.

The driver feeds them forward 250 times a second on computers that have no physics engine.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain

STANDARD_GRAVITY = 9.81  # m/s^2


class GravityModel:
    """The torques that hold an arm of revolute joints still.

    The static half of the recursive Newton-Euler algorithm: gravity is carried outwards into each joint's
    frame, forces and moments come back inwards. Written out on floats: for six joints that is an order of
    magnitude faster than arrays of three.
    """

    def __init__(
        self, description: ArmDescription, gravity: ArrayLike = (0.0, 0.0, -STANDARD_GRAVITY)
    ) -> None:
        """Reads the `<inertial>` of every link from base to tip; links without one weigh nothing.

        `gravity` [m/s^2] is given in the base frame, so a tilted base is a rotated vector. Raises ValueError
        for a joint that is not revolute.
        """
        self._gravity = tuple(float(x) for x in np.asarray(gravity, dtype=float))
        inertials = _inertials(description.urdf)
        sliding = [joint.name for joint in description.joints() if joint.type == "prismatic"]
        if sliding:
            raise ValueError(f"joint {sliding[0]!r} is prismatic; the gravity model knows revolute joints")
        chain = array_chain(description)
        self.dof = chain.dof
        self._joints = [
            _JointFrame(place, _floats(rotation), _floats(offset))
            for place, (rotation, offset) in zip(chain.columns, chain.steps, strict=True)
        ]
        for name, (body, (rotation, position)) in chain.links.items():
            if body and name in inertials:
                mass, centre = inertials[name]
                self._joints[body - 1].add(mass, rotation @ centre + position)

    def torques(self, q: ArrayLike) -> NDArray[np.float64]:
        """Joint torques [Nm] (dof,) that balance gravity at joint angles `q` [rad] (dof,)."""
        angles = np.asarray(q, dtype=float)
        if angles.shape != (self.dof,):
            raise ValueError(f"expected {self.dof} joint angles, got shape {angles.shape}")
        at = angles.tolist()
        gx, gy, gz = self._gravity
        rotations, gravities = [], []
        for joint in self._joints:
            s, c = math.sin(at[joint.place]), math.cos(at[joint.place])
            a, b, z = joint.columns
            x = (c * a[0] + s * b[0], c * a[1] + s * b[1], c * a[2] + s * b[2])
            y = (c * b[0] - s * a[0], c * b[1] - s * a[1], c * b[2] - s * a[2])
            gx, gy, gz = (gx * v[0] + gy * v[1] + gz * v[2] for v in (x, y, z))
            rotations.append((x, y, z))
            gravities.append((gx, gy, gz))
        torques = np.zeros(self.dof)
        fx = fy = fz = nx = ny = nz = 0.0
        for joint, (x, y, z), (gx, gy, gz) in zip(
            reversed(self._joints), reversed(rotations), reversed(gravities), strict=True
        ):
            m, (hx, hy, hz), (px, py, pz) = joint.mass, joint.moment, joint.offset
            fx, fy, fz = fx - m * gx, fy - m * gy, fz - m * gz
            nx, ny, nz = nx - hy * gz + hz * gy, ny - hz * gx + hx * gz, nz - hx * gy + hy * gx
            torques[joint.place] = nz
            fx, fy, fz = (x[i] * fx + y[i] * fy + z[i] * fz for i in range(3))
            nx, ny, nz = (x[i] * nx + y[i] * ny + z[i] * nz for i in range(3))
            nx, ny, nz = nx + py * fz - pz * fy, ny + pz * fx - px * fz, nz + px * fy - py * fx
        return torques


class _JointFrame:
    """A joint about its own z axis: pose in the frame before it, mass and first moment of what it carries."""

    def __init__(self, place: int, rotation: tuple[float, ...], offset: tuple[float, ...]) -> None:
        self.place, self.offset = place, offset
        self.columns = tuple(rotation[i::3] for i in range(3))
        self.mass = 0.0
        self.moment: tuple[float, ...] = (0.0, 0.0, 0.0)

    def add(self, mass: float, centre: NDArray) -> None:
        self.mass += mass
        self.moment = tuple(float(h + mass * c) for h, c in zip(self.moment, centre, strict=True))


def _floats(values: NDArray) -> tuple[float, ...]:
    return tuple(float(value) for value in values.ravel())


def _inertials(urdf: str) -> dict[str, tuple[float, NDArray]]:
    """Mass [kg] and centre of mass [m, link frame] of each link that has them."""
    found = {}
    for link in ElementTree.fromstring(urdf).findall("link"):
        inertial = link.find("inertial")
        mass = None if inertial is None else inertial.find("mass")
        if inertial is None or mass is None:
            continue
        origin = inertial.find("origin")
        xyz = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        found[link.get("name", "")] = (
            float(mass.get("value", "0")),
            np.array([float(x) for x in xyz.split()]),
        )
    return found
