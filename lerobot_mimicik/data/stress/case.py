"""One episode of a stress set, and how it becomes an episode of a dataset."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_mimicik.data.arm_arrays import ArmArrays, Array
from lerobot_mimicik.data.writer import Episode
from lerobot_mimicik.kinematics.tremor import displaced


@dataclass(frozen=True, eq=False)
class StressCase:
    """One episode of T frames.

    Attributes:
        state: Measured joints, (T, dof), rad (m).
        action: Joints of the reference motion at the next frame, (T, dof), rad (m).
        asked: `T_base_tool` that a solver is asked for, (T, 7), xyzw.
        clean: The same without what was added to it (tremor, seams), (T, 7).
        closest: The pose nearest to `asked` that the arm can have, (T, 7); None where all can be reached.
        task: What happens, a sentence.
    """

    state: Array
    action: Array
    asked: Array
    clean: Array
    task: str
    closest: Array | None = None

    @classmethod
    def along(cls, arm: ArmArrays, q: Array, task: str, twist: Array | None = None) -> StressCase:
        """A reference motion (T + 1, dof), and what is added to its poses, (T, 6): m, rad, base frame."""
        clean = arm.pose(q[1:])
        return cls(q[:-1], q[1:], clean if twist is None else displaced(clean, twist), clean, task)

    def episode(self, arm: ArmArrays, session: str) -> Episode:
        """The episode as it goes into a dataset."""
        return Episode(
            state=self.state,
            action=self.action,
            ee_pose=arm.pose(self.state),
            ee_target=self.asked,
            task=self.task,
            session=session,
            ee_target_clean=self.clean,
            ee_target_closest=self.closest,
        )
