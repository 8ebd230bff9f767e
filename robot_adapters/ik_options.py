"""Options of the inverse kinematics inside robots and commands."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.arms import ArmDescription
    from robot_adapters.adapter import AdapterSettings, MimicIKAdapter


@dataclass
class IKOptions:
    """What proposes joints beside the guided solver, and how commands are judged; see `AdapterSettings`."""

    # MimicIK checkpoint: a folder, a training run's output folder, a Hub repository, or a file of mimicik export; or an
    # arm whose foresight is in the package (airbot_play). Empty or none: the guided solver alone.
    path: str = ""
    # In its place, an IK server on this or another computer (mimicik serve): tcp://HOST:PORT.
    address: str = ""
    # Which of the server's solvers.
    solver: str = "mimicik"
    # Where the server has keys: the own secret key and the server's public key.
    secret_key: str = ""
    server_key: str = ""
    # Where the network runs: cpu, cuda, mps.
    device: str = "cpu"
    # Joints that a step starts from: commanded (the command in force) or measured.
    reference: str = "commanded"
    # Largest joint motion of one command [rad].
    max_step: float = 0.095
    # Error of a target that counts as reached [m].
    position_tolerance: float = 0.002
    # Error of a target that counts as reached [rad].
    rotation_tolerance: float = 0.02
    # How the orientation counts: auto, full, ranged (positions first), axis (tool_axis must point right) or position.
    orientation: str = "auto"
    # Axis of the tool for orientation=axis: x, y, z, -x, -y or -z.
    tool_axis: str = "z"
    # Joints that an arm with joints to spare stays near, where the pose leaves them free [rad]; empty: its home.
    posture: list[float] = field(default_factory=list)

    def load(self, arm: str | ArmDescription = "airbot_play") -> MimicIKAdapter:
        """The adapter, for an arm; a checkpoint may know another tool of it.

        Raises:
            ValueError: With path and address, or a checkpoint of another arm; FileNotFoundError, TypeError: if there is no
                MimicIK checkpoint; TimeoutError: nobody answers at the address.
        """
        from lerobot_mimicik.foresight.weights import shipped
        from lerobot_mimicik.kinematics.arms import describe_arm
        from robot_adapters.adapter import MimicIKAdapter

        path = "" if self.path == "none" else self.path
        if path and self.address:
            raise ValueError("ik.path and ik.address are both given: which of the two shall answer?")
        if not path and not self.address:
            return MimicIKAdapter.for_arm(arm, **asdict(self.settings()))
        if path in shipped():
            return MimicIKAdapter.for_arm(arm, path, **asdict(self.settings()))
        description = describe_arm(arm) if isinstance(arm, str) else arm
        if path:
            adapter = MimicIKAdapter.from_pretrained(path, self.device, **asdict(self.settings()))
            adapter.check_arm(description, f"ik.path={path}")
            return adapter
        from lerobot_mimicik.kinematics.chain import SerialArm
        from lerobot_mimicik.solvers import make_solver

        keys = {"secret_key": self.secret_key, "server_key": self.server_key}
        solver = make_solver(
            "remote", SerialArm(description), address=self.address, solver=self.solver, **keys
        )
        adapter = MimicIKAdapter(solver, description, self.settings())
        adapter.warm_up()
        return adapter

    def settings(self) -> AdapterSettings:
        """The adapter's settings. Raises ValueError for one out of range."""
        from robot_adapters.adapter import AdapterSettings

        return AdapterSettings(
            reference=self.reference,
            max_step=self.max_step,
            position_tolerance=self.position_tolerance,
            rotation_tolerance=self.rotation_tolerance,
            orientation=self.orientation,
            tool_axis=self.tool_axis,
            posture_joints=tuple(self.posture),
        )
