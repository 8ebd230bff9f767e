"""A trained policy as a solver: MimicIK, or one of its learned baselines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import repeat
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_mimicik.checkpoints import FORESIGHT, LEARNED, kind_of, load_policy
from lerobot_mimicik.inference.engines import check_engine
from lerobot_mimicik.inference.single import SingleQuery
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.base import Array, IKSolver, SolverFactory, register_solver

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


@register_solver("mimicik")
class MimicIKSolver(IKSolver):
    """Asks a learned policy of any kind, and keeps the few frames of history that it looks at.

    The history lives here rather than in the policy so that rows of a batch may end at different times
    (`select`). Before the first step the history is the first frame repeated, as in training.
    """

    batched = True

    def __init__(
        self,
        arm: SerialArm,
        policy: LearnedIKPolicy | str,
        name: str | None = None,
        device: str | None = None,
        chunk: int = 4096,
        engine: str = "auto",
    ) -> None:
        """
        Args:
            arm: The arm of the recordings; must have as many joints as the policy's own.
            policy: A loaded policy, or a folder or Hub repository to load it from.
            name: How tables call it; None is the checkpoint's kind.
            device: Where the policy runs; None leaves a loaded policy where it is.
            chunk: Most queries answered in one forward pass by `solve_recorded`.
            engine: What computes single queries: one of `ENGINES`, or "auto", the fastest that agrees.

        Raises:
            ValueError: If the policy drives another number of joints than `arm` has or answers no single frames
                (foresight), or there is no such engine.
        """
        self.policy: LearnedIKPolicy = load_policy(policy, device) if isinstance(policy, str) else policy
        if device is not None:
            self.policy = self.policy.to(device)
        if kind_of(self.policy.config) == FORESIGHT.name:
            raise ValueError(
                "The policy is foresight's, which steadies what the guided solver is asked for: the solver "
                "foresight runs it."
            )
        own = self.policy.arm
        if own.dof != arm.dof:
            raise ValueError(
                f"The policy drives {own.dof} joints {own.joint_names}, "
                f"the recordings have {arm.dof}: {arm.joint_names}."
            )
        self.policy.eval()
        self.name = name or kind_of(self.policy.config)
        self.steps = int(self.policy.config.n_obs_steps)
        self.chunk = chunk
        self._device = next(self.policy.parameters()).device
        self._engine = check_engine(engine)
        self._single: SingleQuery | None = None
        self._q: Array | None = None
        self._target: Array | None = None

    @property
    def step_range(self) -> tuple[Array, Array] | None:
        """The steps that the policy saw in training; None where it was not conditioned on them."""
        relative = getattr(self.policy.conditioning, "relative", None)
        if relative is None:
            return None
        return relative.lower.double().cpu().numpy(), relative.upper.double().cpu().numpy()

    @property
    def engine(self) -> str | None:
        """What computes single queries, by name; None before the first one, which makes the engine."""
        return None if self._single is None else self._single.name

    def __getstate__(self) -> dict[str, Any]:
        """Without the engine, which does not pickle; it is made again when asked."""
        return self.__dict__ | {"_single": None}

    def reset(self, q: Array) -> None:
        """Forget the history; the next `solve` starts a new one."""
        self._q = None
        self._target = None

    def select(self, rows: NDArray[np.intp]) -> None:
        """Keep the history of these rows."""
        if self._q is not None and self._target is not None:
            self._q, self._target = self._q[rows], self._target[rows]

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The policy's command; (B, dof) and (B, 7), or (dof,) and (7,)."""
        if q_curr.ndim == 1:
            return self.solve(q_curr[None], target_pose[None])[0]
        return np.concatenate(list(self.solve_in_pieces(q_curr, target_pose, repeat(len(q_curr)))))

    def solve_in_pieces(self, q_curr: Array, target_pose: Array, rows: Iterable[int]) -> Iterator[Array]:
        """The policy's commands, a forward pass for every piece of `rows`."""
        if q_curr.ndim == 1:
            yield self.solve(q_curr, target_pose)
            return
        self._q = q = _push(self._q, q_curr, self.steps)
        self._target = target = _push(self._target, target_pose, self.steps)
        for piece in _pieces(len(q), rows):
            yield self._ask(q[piece], target[piece])

    def recorded_in_pieces(self, q_curr: Array, target_pose: Array, rows: Iterable[int]) -> Iterator[Array]:
        """All frames of one recording, in forward passes of at most `chunk` and `rows` frames."""
        frames = np.maximum(np.arange(len(q_curr))[:, None] - np.arange(self.steps)[::-1], 0)
        for piece in _pieces(len(frames), (min(most, self.chunk) for most in rows)):
            yield self._ask(q_curr[frames[piece]], target_pose[frames[piece]])

    def _ask(self, q: Array, target: Array) -> Array:
        """(B, T_o, dof) and (B, T_o, 7) -> (B, dof)."""
        if len(q) == 1:
            if self._single is None:
                self._single = SingleQuery.of(self.policy, self._engine)
            return self._single(q[0], target[0])[None]
        to_tensor = {"dtype": torch.float32, "device": self._device}
        with torch.inference_mode():
            command = self.policy.predict_joints(
                torch.as_tensor(q, **to_tensor), torch.as_tensor(target, **to_tensor)
            )
        return command.double().cpu().numpy()


def _solver_of(kind: str) -> SolverFactory:
    def make(arm: SerialArm, policy: LearnedIKPolicy | str, **options: Any) -> MimicIKSolver:
        solver = MimicIKSolver(arm, policy, **options)
        found = kind_of(solver.policy.config)
        if found != kind:
            raise ValueError(f"The solver {kind} needs a checkpoint of that kind; this one is {found}.")
        return solver

    return make


for _kind in LEARNED[1:]:
    register_solver(_kind)(_solver_of(_kind))


def _pieces(count: int, sizes: Iterable[int]) -> Iterator[slice]:
    """Successive parts of `count` rows, each of the next size at most."""
    start = 0
    for size in sizes:
        if start >= count:
            return
        yield slice(start, start + size)
        start += size


def _push(history: Array | None, frame: Array, steps: int) -> Array:
    """Append a frame (B, n) to a history (B, steps, n), dropping the oldest; None starts one."""
    if history is None:
        return np.repeat(frame[:, None], steps, axis=1)
    return np.concatenate([history[:, 1:], frame[:, None]], axis=1)
