"""Forward kinematics and Jacobian of a serial arm on numpy arrays, laid out for speed.

`SerialArm` serves training: differentiable, on any device. Making data takes hundreds of millions of small
transforms on a processor and no gradients; with one long array per matrix component numpy does them twenty
times faster. Both read the same description and agree to rounding (there is a test).
"""

from __future__ import annotations

import functools

import numpy as np

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.urdf import Joint

Pose = tuple[np.ndarray, np.ndarray]
"""Rotation (3, 3) and position (3,)."""


class ArrayChain:
    """Kinematics of the arm of a description, numpy float64.

    A body is what moves as one: body 0 is the base, body j what the j-th movable joint from the base carries.
    Its frame here has the joint's axis as z.

    Attributes:
        dof: Number of movable joints, in the order of the description's `joint_names`.
        links: For every link from base to tip, fixed ones included, its body and its pose T_body_link.
        steps: Constant poses from the frame of one movable joint, its axis as z, to the next, from the base on.
        columns, prismatic: Where each of these joints stands in the joint vector, and whether it slides.
        tool: Constant pose from the last of these frames to the tool.
    """

    def __init__(self, description: ArmDescription) -> None:
        path = description.chain()
        names = description.joint_names
        self._joints = [joint for joint in path if joint.movable]
        self.prismatic = [joint.type == "prismatic" for joint in self._joints]
        self.columns = [names.index(joint.name) for joint in self._joints]
        self.dof = len(names)
        self.links: dict[str, tuple[int, Pose]] = {}
        self.steps: list[Pose] = []
        body, pose = 0, (np.eye(3), np.zeros(3))
        self.links[path[0].parent] = (body, pose)
        for joint in path:
            pose = compose_frames(pose, (rotation_from_rpy(joint.origin_rpy), np.array(joint.origin_xyz)))
            if joint.movable:
                align = _z_onto(np.array(joint.axis))
                self.steps.append(compose_frames(pose, (align, np.zeros(3))))
                body, pose = body + 1, (align.T, np.zeros(3))
            self.links[joint.child] = (body, pose)
        offset = (*description.tool_offset, *(0.0,) * (6 - len(description.tool_offset)))
        self.tool = compose_frames(pose, (rotation_from_rpy(offset[3:]), np.array(offset[:3])))

    def forward(self, q: np.ndarray) -> Pose:
        """Tool rotation (N, 3, 3) and position (N, 3) in the base frame, of joints (N, dof)."""
        columns, position = _follow(self._walk(q)[-1], self.tool)
        return np.ascontiguousarray(columns.transpose(2, 1, 0)), np.ascontiguousarray(position.T)

    def pose(self, q: np.ndarray) -> np.ndarray:
        """`T_base_tool` (N, 7), x y z qx qy qz qw with qw >= 0, of joints (N, dof)."""
        rotation, position = self.forward(q)
        return np.concatenate([position, quaternion_from_matrix(rotation)], axis=1)

    def forward_and_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tool rotation (N, 3, 3), position (N, 3) and geometric Jacobian (N, 6, dof), linear rows first."""
        frames = self._walk(q)
        columns, position = _follow(frames[-1], self.tool)
        jacobian = np.zeros((6, self.dof, len(q)))
        for joint, column, (frame, origin) in zip(self._joints, self.columns, frames[1:], strict=True):
            axis = frame[2]
            if joint.type == "prismatic":
                jacobian[:3, column] = axis
                continue
            arm = position - origin
            jacobian[0, column] = axis[1] * arm[2] - axis[2] * arm[1]
            jacobian[1, column] = axis[2] * arm[0] - axis[0] * arm[2]
            jacobian[2, column] = axis[0] * arm[1] - axis[1] * arm[0]
            jacobian[3:, column] = axis
        return (
            np.ascontiguousarray(columns.transpose(2, 1, 0)),
            np.ascontiguousarray(position.T),
            np.ascontiguousarray(jacobian.transpose(2, 0, 1)),
        )

    def body_points(self, q: np.ndarray, points: list[np.ndarray]) -> list[np.ndarray]:
        """Points fixed to the bodies, in the base frame.

        Args:
            q: Joints (N, dof).
            points: For each of the dof + 1 bodies its points in the body's frame, shape (P_b, 3).

        Returns:
            For each body its points in the base frame, shape (P_b, 3, N).
        """
        moved = []
        for (columns, position), own in zip(self._walk(q), points, strict=True):
            moved.append((own @ columns.reshape(3, -1)).reshape(len(own), *position.shape) + position)
        return moved

    def stretched_length(self, after: int) -> float:
        """Sum of the distances between joints, from the `after`-th joint on to the tool [m]."""
        offsets = [position for _, position in (*self.steps[after:], self.tool)]
        return float(sum(np.linalg.norm(offset) for offset in offsets))

    def _walk(self, q: np.ndarray) -> list[Pose]:
        """Frames of all bodies: rotations as (3 columns, xyz, N), origins as (xyz, N), all contiguous."""
        q = np.asarray(q, dtype=np.float64)
        if q.ndim != 2 or q.shape[1] != self.dof:
            raise ValueError(f"expected joints of shape (N, {self.dof}), got {q.shape}")
        values = np.ascontiguousarray(q.T)
        sines, cosines = np.sin(values), np.cos(values)
        frame: Pose = (np.repeat(np.eye(3)[:, :, None], len(q), axis=2), np.zeros((3, len(q))))
        frames = [frame]
        for joint, column, step in zip(self._joints, self.columns, self.steps, strict=True):
            frame = _moved(_follow(frame, step), joint, values[column], sines[column], cosines[column])
            frames.append(frame)
        return frames


@functools.lru_cache(maxsize=8)
def array_chain(description: ArmDescription) -> ArrayChain:
    """The chain of a description, built once per process."""
    return ArrayChain(description)


def compose_frames(a: Pose, b: Pose) -> Pose:
    """The pose a b."""
    return a[0] @ b[0], a[1] + a[0] @ b[1]


def quaternion_from_matrix(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternions xyzw with w >= 0, (N, 4), of rotation matrices (N, 3, 3).

    The products of the quaternion's components with its largest one, normalised (Shepperd 1978).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.transpose(1, 2, 0)
    products = np.array(
        [
            [1 + xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy],
            [zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz],
        ]
    )
    largest = np.argmax(np.einsum("iin->in", products), axis=0)
    found = products[largest, :, np.arange(len(rotation))]
    found /= np.sqrt((found * found).sum(axis=1, keepdims=True))
    return np.where(found[:, 3:] < 0, -found, found)


def rotation_from_rpy(rpy: tuple[float, ...]) -> np.ndarray:
    """Rotation matrix of URDF's roll, pitch, yaw [rad]: Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, cr), (sp, cp), (sy, cy) = ((np.sin(angle), np.cos(angle)) for angle in rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _follow(frame: Pose, step: Pose) -> Pose:
    """A frame per configuration, component-major, followed by a constant pose."""
    flat = frame[0].reshape(3, -1)
    columns = (step[0].T @ flat).reshape(frame[0].shape)
    return columns, frame[1] + (step[1] @ flat).reshape(frame[1].shape)


def _moved(frame: Pose, joint: Joint, value: np.ndarray, sine: np.ndarray, cosine: np.ndarray) -> Pose:
    """A frame moved about, or along, its own z."""
    columns, position = frame
    if joint.type == "prismatic":
        return columns, position + columns[2] * value
    turned = np.empty_like(columns)
    turned[0] = columns[0] * cosine + columns[1] * sine
    turned[1] = columns[1] * cosine - columns[0] * sine
    turned[2] = columns[2]
    return turned, position


def _z_onto(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes z onto a unit axis."""
    if axis[0] == 0 and axis[1] == 0 and axis[2] > 0:
        return np.eye(3)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(axis)))], axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
