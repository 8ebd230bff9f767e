"""Forward kinematics and Jacobian of a serial arm, batched and differentiable, by pytorch_kinematics."""

from __future__ import annotations

from collections.abc import Callable

import pytorch_kinematics as pk
import torch
from torch import Tensor

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.rotations import matrix_to_pose, rpy_to_matrix
from lerobot_mimicik.kinematics.urdf import Joint

_TOOL = "tool"
# Configurations per call of the library on a CPU, so that the transforms in between stay in its cache.
_CPU_CHUNK = 4096


class SerialArm:
    """A serial arm on one device, in one precision.

    Joint vectors q have the order of `joint_names` [rad; m for prismatic joints]. Poses are `T_base_tool` as
    x y z qx qy qz qw (m; xyzw with w >= 0), base being the description's base link and tool its tool frame.

    Inputs may have any leading axes (none included) and any floating dtype; they are computed, and returned,
    in the arm's own dtype, also under autocast and TF32, which would cost millimetres. Gradients flow from
    pose to q.

    Attributes:
        description: What the arm was built from.
        dof: Number of movable joints.
        joint_names: Their names, in the order of q.
        lower, upper: Position limits, shape (dof,); infinite for continuous joints.
        velocity: Speed limits [rad/s; m/s], shape (dof,); infinite where the URDF gives none.
        device, dtype: Where and how it computes.
    """

    def __init__(
        self,
        description: ArmDescription,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Build the chain.

        Raises:
            UrdfError: The description does not fit its URDF; see `ArmDescription.chain`. It is a ValueError.
            ValueError: A dtype other than float32 or float64.
        """
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"an arm computes in torch.float32 or torch.float64, not {dtype}")
        self.description = description
        self.device = torch.device(device)
        self.dtype = dtype
        path = description.chain()
        chain_order = [joint.name for joint in path if joint.movable]
        self.joint_names = description.joint_names
        self.dof = len(self.joint_names)
        joints = {joint.name: joint for joint in path}
        limits = [(joints[n].lower, joints[n].upper, joints[n].velocity) for n in self.joint_names]
        columns = torch.tensor(limits, dtype=dtype, device=self.device).unbind(1)
        self.lower, self.upper, self.velocity = columns
        # q[..., to_chain] is in chain order, columns[..., from_chain] in the user's.
        self._reordered = list(self.joint_names) != chain_order
        self._to_chain = torch.tensor([self.joint_names.index(n) for n in chain_order], device=self.device)
        self._from_chain = torch.tensor([chain_order.index(n) for n in self.joint_names], device=self.device)
        # lerobot-train lets matrix products of float32 round to TF32 on NVIDIA GPUs, about 1e-3: some tenths
        # of a millimetre here. Float64 is left alone, and costs little beside launching such small kernels.
        self._inner_dtype = torch.float64 if self.device.type == "cuda" else dtype
        self._chain = _build_chain(path, description.tool_offset, self.device, self._inner_dtype)
        self._tool_index = self._chain.frame_to_idx[_TOOL]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> SerialArm:
        """The arm on another device or in another precision.

        As with a tensor, and unlike an `nn.Module`, the arm itself is left as it is: use the returned one
        (the same object when nothing changes). It is rebuilt from the URDF: float64 is not rounded float32.
        """
        device = self.device if device is None else torch.device(device)
        dtype = self.dtype if dtype is None else dtype
        if (device, dtype) == (self.device, self.dtype):
            return self
        return SerialArm(self.description, device, dtype)

    def forward(self, q: Tensor) -> Tensor:
        """Tool poses `T_base_tool`. Shape (*, dof) -> (*, 7).

        Raises:
            ValueError: The last axis of `q` is not dof long, or `q` is on another device.
        """
        return self._map(lambda rows: matrix_to_pose(self._transforms(rows)), q)

    def matrix(self, q: Tensor) -> Tensor:
        """Homogeneous transforms of the tool in the base. Shape (*, dof) -> (*, 4, 4). Errors: `forward`."""
        return self._map(self._transforms, q)

    def jacobian(self, q: Tensor) -> Tensor:
        """Geometric Jacobian at the tool point, in the base frame. Shape (*, dof) -> (*, 6, dof).

        Rows 0-2 give the tool point's velocity [m/s], rows 3-5 the angular velocity [rad/s] per unit joint
        speed. Errors as for `forward`.
        """
        jacobian = self._map(self._chain.jacobian, q)
        return jacobian[..., self._from_chain] if self._reordered else jacobian

    def _transforms(self, rows: Tensor) -> Tensor:
        return self._chain.forward_kinematics_tensor(rows)[self._tool_index]

    def _map(self, function: Callable[[Tensor], Tensor], q: Tensor) -> Tensor:
        """Apply a function of (n, dof) joint rows in chain order to q with its own leading axes."""
        if q.shape[-1:] != (self.dof,):
            raise ValueError(
                f"expected joints of shape (*, {self.dof}) for {', '.join(self.joint_names)}; found "
                f"{tuple(q.shape)}"
            )
        if q.device.type != self.device.type:
            raise ValueError(f"joints are on {q.device}, the arm is on {self.device}; move one of them")
        rows = q.to(self._inner_dtype).reshape(-1, self.dof)
        if self._reordered:
            rows = rows[:, self._to_chain]
        with torch.autocast(self.device.type, enabled=False):
            if self.device.type == "cpu" and len(rows) > _CPU_CHUNK:
                result = torch.cat([function(chunk) for chunk in rows.split(_CPU_CHUNK)])
            else:
                result = function(rows)
        return result.reshape(*q.shape[:-1], *result.shape[1:]).to(self.dtype)


def _build_chain(
    path: tuple[Joint, ...], tool_offset: tuple[float, ...], device: torch.device, dtype: torch.dtype
) -> pk.SerialChain:
    """The library's chain with one frame per movable joint and one for the tool.

    Built from our own reading of the URDF rather than by the library's parser, which rounds to float32 and
    needs every other element of the file to be to its liking. Fixed joints are folded into the next frame:
    time goes with frames.
    """
    root = frame = pk.Frame("base", link=pk.Link("base"), joint=pk.Joint("base_fixed", dtype=torch.float64))
    offset = torch.eye(4, dtype=torch.float64)
    for joint in path:
        offset = offset @ fixed_transform((*joint.origin_xyz, *joint.origin_rpy))
        if joint.movable:
            frame = _append(frame, joint.name, offset, joint)
            offset = torch.eye(4, dtype=torch.float64)
    _append(frame, _TOOL, offset @ fixed_transform(tool_offset), None)
    chain = pk.Chain(root, dtype=torch.float64)
    return pk.SerialChain(chain, _TOOL, dtype=torch.float64).to(dtype=dtype, device=device)


def _append(parent: pk.Frame, name: str, offset: Tensor, joint: Joint | None) -> pk.Frame:
    # The joint's own name could be "tool" or "base"; a frame's must not.
    frame_name = name if joint is None else f"joint {name}"
    if joint is None:
        kind, axis = "fixed", (0.0, 0.0, 1.0)
    else:
        kind, axis = ("prismatic" if joint.type == "prismatic" else "revolute"), joint.axis
    frame = pk.Frame(
        frame_name,
        link=pk.Link(frame_name),
        joint=pk.Joint(name, pk.Transform3d(matrix=offset, dtype=torch.float64), kind, axis, torch.float64),
    )
    parent.add_child(frame)
    return frame


def fixed_transform(xyz_rpy: tuple[float, ...]) -> Tensor:
    """Homogeneous transform of (), xyz or xyz + rpy, in float64."""
    x, y, z, roll, pitch, yaw = (*xyz_rpy, *(0.0,) * (6 - len(xyz_rpy)))
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = rpy_to_matrix(torch.tensor([roll, pitch, yaw], dtype=torch.float64))
    transform[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return transform
