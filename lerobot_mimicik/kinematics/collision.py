"""Self- and floor collision of an arm, from spheres laid into the collision shapes of its URDF.

Spheres, cylinders and boxes are covered by spheres of their own thickness; meshes are left out. An arm
without such shapes has no collisions here, only joint limits. Links that a fixed joint ties together are one
body; neighbours in the chain never count, nor do pairs that touch in the reference configuration (wrist
housings that interpenetrate in the model).
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.shapes import Shape, read_shapes


class ArmCollision:
    """Clearance of an arm to itself and to the floor.

    Attributes:
        spheres: Number of spheres on the arm; 0 means that nothing is ever checked.
        pairs: Number of sphere pairs that are checked.
    """

    def __init__(self, description: ArmDescription, reference: np.ndarray, floor: float | None = 0.0) -> None:
        """Lay the spheres and leave out what touches in the reference configuration.

        Args:
            description: The arm.
            reference: Joints [rad] known to be free of collision, shape (dof,), such as a home configuration.
            floor: Height of the floor in the base frame (z up) [m], or None for no floor. The base and the
                first moving body stand on it and do not count.
        """
        self._chain = array_chain(description)
        self._centres, self._radii, bodies = _spheres(description)
        self._bodies = bodies
        self._floor = floor
        self.spheres = len(self._radii)
        pairs = [
            (a, b)
            for a, b in itertools.combinations(range(self.spheres), 2)
            if abs(bodies[a] - bodies[b]) >= 2
        ]
        self._a = np.array([pair[0] for pair in pairs], dtype=int)
        self._b = np.array([pair[1] for pair in pairs], dtype=int)
        self._above = np.flatnonzero(bodies >= 2) if floor is not None else np.array([], dtype=int)
        if self.spheres:
            self._leave_out_touching(np.asarray(reference, dtype=np.float64), bodies)
        self.pairs = len(self._a)

    def clearance(self, q: np.ndarray) -> np.ndarray:
        """Smallest distance between checked spheres, or from a sphere to the floor [m]: (N, dof) -> (N,).

        Negative: they interpenetrate by so much. Infinite: nothing to check.
        """
        q = np.asarray(q, dtype=np.float64)
        closest = np.full(len(q), np.inf)
        if not self.spheres or len(q) == 0:
            return closest
        points = self._points(q)
        if len(self._a):
            closest = self._pair_clearance(points).min(axis=0)
        if len(self._above):
            closest = np.minimum(closest, self._height(points).min(axis=0))
        return closest

    def sphere_arrays(self) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """What is checked, as arrays.

        Returns:
            Of the spheres the centres in their bodies' frames (S, 3) [m], radii (S,) [m] and bodies (S,); and the pairs of
            spheres (P, 2).
        """
        centres = np.concatenate([np.zeros((0, 3)), *self._centres])
        pairs = np.stack([self._a, self._b], axis=1).astype(np.int64)
        return (centres, self._radii.astype(float), self._bodies.astype(np.int64)), pairs

    def _leave_out_touching(self, reference: np.ndarray, bodies: np.ndarray) -> None:
        points = self._points(reference[None])
        touching = self._pair_clearance(points)[:, 0] < 0
        ignored = set(zip(bodies[self._a[touching]], bodies[self._b[touching]], strict=True))
        keep = np.array(
            [pair not in ignored for pair in zip(bodies[self._a], bodies[self._b], strict=True)], dtype=bool
        )
        self._a, self._b = self._a[keep], self._b[keep]
        if len(self._above):
            resting = bodies[self._above[self._height(points)[:, 0] < 0]]
            self._above = self._above[~np.isin(bodies[self._above], resting)]

    def _pair_clearance(self, points: np.ndarray) -> np.ndarray:
        difference = points[self._a] - points[self._b]
        distance = np.sqrt((difference**2).sum(axis=1))
        return distance - (self._radii[self._a] + self._radii[self._b])[:, None]

    def _height(self, points: np.ndarray) -> np.ndarray:
        return points[self._above, 2] - self._radii[self._above, None] - self._floor

    def _points(self, q: np.ndarray) -> np.ndarray:
        """Sphere centres in the base frame, (S, 3, N); spheres are numbered body by body."""
        return np.concatenate(self._chain.body_points(q, self._centres))


def _spheres(description: ArmDescription) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Sphere centres by body, in the body's frame; all radii (S,) and bodies (S,), body by body."""
    found: list[list[tuple[np.ndarray, float]]] = [[] for _ in range(array_chain(description).dof + 1)]
    for shape in read_shapes(description):
        found[shape.body] += _cover(shape)
    centres = [np.array([centre for centre, _ in own]).reshape(-1, 3) for own in found]
    radii = np.array([radius for own in found for _, radius in own])
    bodies = np.repeat(np.arange(len(found)), [len(own) for own in found])
    return centres, radii, bodies


def _cover(shape: Shape) -> list[tuple[np.ndarray, float]]:
    """Spheres (centre in the body's frame, radius) that cover a shape."""
    if shape.kind == "sphere":
        half: np.ndarray = np.full(3, shape.size[0])
    elif shape.kind == "box":
        half = np.array(shape.size) / 2
    else:
        radius, length = shape.size
        half = np.array([radius, radius, length / 2])
    # Balls of the middle half-extent in a row along the longest: they overlap by half and fill the thickness.
    axis = int(np.argmax(half))
    radius = float(np.sort(half)[1])
    if radius <= 0:
        return []
    reach = max(0.0, float(half[axis]) - radius)
    offsets = np.linspace(-reach, reach, 1 + math.ceil(2 * reach / radius))
    rotation, position = shape.pose
    return [(position + rotation @ (np.eye(3)[axis] * offset), radius) for offset in offsets]
