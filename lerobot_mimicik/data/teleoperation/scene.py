"""Where synthetic teleoperation happens: arm, workspace, everyday places and singular configurations."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.teleoperation.hand_motion import OperatorStyle
from lerobot_mimicik.data.teleoperation.hand_tracking import solve_poses, weighted
from lerobot_mimicik.data.teleoperation.singularities import KINDS, NEAR, SingularityGauge, find_singular
from lerobot_mimicik.kinematics.arms import ArmDescription

# The workspace of the paper's recordings (m), and the reach of the arm that made them: other arms get a
# workspace in proportion.
PAPER_WORKSPACE_M = (0.43, 0.40, 0.23)
PAPER_REACH_M = 0.65
_FURTHEST_FROM_HOME_RAD = 2.0  # everyday configurations stay on the home posture's side of the joint space
_SINGULAR_POOL = 40
ILL_CONDITIONED = "ill-conditioned"
"""The kind of the configurations that stand for singular ones on an arm that has none within its limits."""


@dataclass(frozen=True)
class Places:
    """Places an operator works at.

    Attributes:
        hand: Tool poses as in `hand_motion`, about the orientation `reference`, (n, 6).
        joints: A configuration for each [rad], (n, dof).
        reference: The session's preferred tool orientation in the base frame.
    """

    hand: Array
    joints: Array
    reference: Rotation

    def matrices(self, hand: Array) -> Array:
        """Hand poses (*, 6) as T_base_tool (*, 4, 4)."""
        flat = hand.reshape(-1, 6)
        out = np.tile(np.eye(4), (len(flat), 1, 1))
        out[:, :3, 3] = flat[:, :3]
        out[:, :3, :3] = (Rotation.from_rotvec(flat[:, 3:]) * self.reference).as_matrix()
        return out.reshape(*hand.shape[:-1], 4, 4)


@dataclass
class Scene:
    """One arm in its workspace. Cheap to rebuild from its fields in another process.

    Attributes:
        description: The arm.
        gauge_scale: Scales of the singularity gauge by kind.
        reach_m: How far the tool gets from the middle of all it can reach [m].
        singular: Singular configurations by kind, (n, dof); kinds that the arm does not have are absent. An arm with none
            (joints to spare, narrow limits) has its worst conditioned ones instead, as `ILL_CONDITIONED`.
        arm, gauge: Its kinematics and its singularity gauge.
        workspace: Extent of the box in which operators work, about the home pose [m], (3,).
        home_pose: T_base_tool of the home configuration, (4, 4).
    """

    description: ArmDescription
    gauge_scale: dict[str, float]
    reach_m: float
    singular: dict[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.arm = ArmArrays(self.description)
        self.gauge = SingularityGauge(self.arm, self.gauge_scale)
        self.workspace = np.array(PAPER_WORKSPACE_M) * self.reach_m / PAPER_REACH_M
        self.home_pose = self.arm.matrix(self.arm.home[None])[0]

    def __reduce__(self) -> tuple:
        return Scene, (self.description, self.gauge_scale, self.reach_m, self.singular)

    @classmethod
    def of(cls, description: ArmDescription, rng: np.random.Generator) -> "Scene":
        """Measures the arm and looks for its singular configurations."""
        arm = ArmArrays(description)
        gauge = SingularityGauge.for_arm(arm, rng)
        sample = arm.matrix(rng.uniform(arm.lower, arm.upper, size=(2048, len(arm.home))))[:, :3, 3]
        reach_m = float(np.linalg.norm(sample - sample.mean(axis=0), axis=1).max())
        scene = cls(description, gauge.scale, reach_m)
        for kind in KINDS:
            found = scene._singular_pool(kind, rng)
            if len(found):
                scene.singular[kind] = found
        if not scene.singular:
            scene.singular[ILL_CONDITIONED] = scene._ill_conditioned(rng)
        return scene

    def places(self, style: OperatorStyle, rng: np.random.Generator, least: int = 16) -> Places:
        """The places of one session: reachable poses about the operator's preferred place and orientation."""
        home_rotation = Rotation.from_matrix(self.home_pose[:3, :3])
        chosen: Array = np.empty((0, len(self.arm.home)))
        for attempt in range(4):
            # Where much of the workspace is out of reach, work closer to the home pose.
            near = 0.75**attempt
            reference = Rotation.from_rotvec(near * np.array(style.tilt)) * home_rotation
            hand = np.empty((160, 6))
            share = style.centre + rng.uniform(-0.5, 0.5, size=(len(hand), 3)) * style.extent
            hand[:, :3] = self.home_pose[:3, 3] + near * share * self.workspace
            hand[:, 3:] = near * rng.normal(size=(len(hand), 3)) * style.tilt_spread
            targets = Places(hand, chosen, reference).matrices(hand)
            q, errors = solve_poses(self.arm, np.tile(self.arm.home, (len(hand), 1)), targets)
            solved = (errors[:, 0] < 5e-3) & (errors[:, 1] < 0.3)
            chosen = np.concatenate([chosen, q[solved & self._everyday(q)]])
            if len(chosen) >= least:
                break
        else:
            q = self.arm.home + rng.normal(size=(160, len(self.arm.home))) * 0.25
            q = np.clip(q, self.arm.lower + 0.05, self.arm.upper - 0.05)
            chosen = np.concatenate([chosen, q[self.arm.free(q)]])
            if len(chosen) < least:
                raise ValueError(
                    f"the arm's home configuration {list(self.description.home)} leaves too little room "
                    f"about it: {len(chosen)} of 160 nearby configurations are free of collisions"
                )
        poses = self.arm.matrix(chosen)
        turn = Rotation.from_matrix(poses[:, :3, :3]) * reference.inv()
        return Places(np.column_stack([poses[:, :3, 3], turn.as_rotvec()]), chosen, reference)

    def _everyday(self, q: Array) -> np.ndarray:
        measures = self.gauge(q)
        margin = 0.2
        inside = np.all((q > self.arm.lower + margin) & (q < self.arm.upper - margin), axis=1)
        close = np.abs(q - self.arm.home).max(axis=1) < _FURTHEST_FROM_HOME_RAD
        # The wrist singularity lies within everyday work, the elbow's and the shoulder's at its border.
        return inside & close & (measures["elbow"] > NEAR) & (measures["shoulder"] > NEAR) & self.arm.free(q)

    def _singular_pool(self, kind: str, rng: np.random.Generator) -> Array:
        """Singular configurations of one kind, the closest to home first, no two nearly alike."""
        arm = self.arm
        start = arm.home + rng.normal(size=(320, len(arm.home))) * 0.6
        found = self._usable(find_singular(self.gauge, kind, start))
        found = found[np.argsort(np.linalg.norm(found - arm.home, axis=1), kind="stable")]
        return self._unlike(found)

    def _ill_conditioned(self, rng: np.random.Generator) -> Array:
        """Configurations about home with the smallest singular values of the Jacobian first, no two nearly alike."""
        arm = self.arm
        start = arm.home + rng.normal(size=(2000, len(arm.home))) * 0.6
        found = self._usable(np.clip(start, arm.lower + 0.11, arm.upper - 0.11))
        values = np.linalg.svd(weighted(arm.jacobian(found)), compute_uv=False)
        return self._unlike(found[np.argsort(values.min(axis=1), kind="stable")])

    def _usable(self, found: Array) -> Array:
        """Those inside the limits, with a margin of 0.1 rad, and free of collisions."""
        margin = 0.1
        inside = np.all((found > self.arm.lower + margin) & (found < self.arm.upper - margin), axis=1)
        found = found[inside]
        return found[self.arm.free(found)] if len(found) else found

    def _unlike(self, found: Array) -> Array:
        """The first ones of which no two are nearly alike."""
        chosen: list[Array] = []
        for q in found:
            if all(np.linalg.norm(q - other) > 0.3 for other in chosen):
                chosen.append(q)
            if len(chosen) == _SINGULAR_POOL:
                break
        return np.array(chosen).reshape(-1, len(self.arm.home))
