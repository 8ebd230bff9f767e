"""The interface of an inverse-kinematics solver, and the registry of those known by name.

A solver answers one question per control step: the arm is at `q_curr`, its tool should be at
`target_pose`, which joints shall be commanded? It sees no future and no recording. Arrays are numpy
float64; joints are in rad in the order of the arm's `joint_names`; a pose is `T_base_tool` as
x y z (m) qx qy qz qw.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from itertools import repeat
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.checkpoints import LEARNED
from lerobot_mimicik.kinematics.names import did_you_mean
from lerobot_mimicik.solvers.availability import Package, SolverUnavailable

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm

Array = NDArray[np.float64]


class IKSolver(ABC):
    """One way to turn a measured configuration and a target pose into a joint command.

    Attributes:
        name: How tables call the solver.
        batched: Whether `reset`, `solve` and `select` take a leading batch axis, one row per arm that
            is driven independently of the others. Without it they take single configurations only.
        look_ahead: How many targets after the present one it makes use of, where they are known (`foresee`).
        configuration: How it is configured and after what, with the source: what tables say beside its row.
    """

    name: str
    batched: bool = False
    look_ahead: int = 0
    configuration: ClassVar[str] = ""

    @property
    def step_range(self) -> tuple[Array, Array] | None:
        """Smallest and largest step (6,) [m, rad] from the present pose to the target that it answers well.

        Translation and rotation vector of R_target R_now^T, in the base frame; None: any step.
        """
        return None

    @abstractmethod
    def reset(self, q: Array) -> None:
        """Forget all history; the arm is at rest at `q` (dof,), or (B, dof) where `batched`, in rad."""

    @abstractmethod
    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The joint command for this control step.

        Args:
            q_curr: Measured joints, (dof,), or (B, dof) where `batched`, in rad.
            target_pose: `T_base_tool` to reach, (7,) or (B, 7).

        Returns:
            Commanded joints, shaped as `q_curr`, absolute, in rad.
        """

    def reset_one(self, q: Array) -> None:
        """`reset` for one arm, at `q` (dof,), whether or not the solver takes batches."""
        self.reset(q[None] if self.batched else q)

    def solve_one(self, q_curr: Array, target_pose: Array) -> Array:
        """`solve` for one arm, (dof,) and (7,) to (dof,), whether or not the solver takes batches."""
        if self.batched:
            return self.solve(q_curr[None], target_pose[None])[0]
        return self.solve(q_curr, target_pose)

    def foresee(self, upcoming: Array) -> None:  # noqa: B027 - most solvers have no use for it
        """Targets (T, 7) of the frames after the one that `solve` is asked for next; holds for that question only."""

    def select(self, rows: NDArray[np.intp]) -> None:  # noqa: B027 - most solvers have nothing to do here
        """Go on with these rows of the batch only, in this order. Stateless solvers need not care."""

    def solve_recorded(self, q_curr: Array, target_pose: Array) -> Array:
        """Answers along one recorded episode, where every query sees the recorded history before it.

        Args:
            q_curr: Recorded joints, (T, dof), in rad.
            target_pose: Recorded targets, (T, 7).

        Returns:
            (T, dof) commands in rad. A solver that can answer many frames at once overrides
            `recorded_in_pieces`.
        """
        return np.concatenate(list(self.recorded_in_pieces(q_curr, target_pose, repeat(len(q_curr)))))

    def solve_in_pieces(self, q_curr: Array, target_pose: Array, rows: Iterable[int]) -> Iterator[Array]:
        """What `solve` answers, computed piece by piece, so that others can be served in between.

        Args:
            q_curr: As in `solve`.
            target_pose: As in `solve`.
            rows: Most rows of a batch in each piece, one number after the other, without end. A solver whose batches
                are answered quickly need not care.

        Yields:
            The rows in their order, (n, dof); (dof,) where `q_curr` has one axis.
        """
        yield self.solve(q_curr, target_pose)

    def recorded_in_pieces(self, q_curr: Array, target_pose: Array, rows: Iterable[int]) -> Iterator[Array]:
        """What `solve_recorded` answers, in pieces of (n, dof) with n at most the next of `rows`."""
        self.reset_one(q_curr[0])
        for q, target in zip(q_curr, target_pose, strict=True):
            yield np.reshape(self.solve_one(q, target), (1, -1))


class OfflineSolver(IKSolver):
    """A solver that knows the future: it answers whole recordings only, by `solve_recorded`.

    Modes drive it along a recording at once instead of frame by frame; those in which commands have consequences that
    nobody can know beforehand (a simulated arm) do not take it.
    """

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """Not answered.

        Raises:
            SolverUnavailable: Always.
        """
        raise SolverUnavailable(
            f"the solver {self.name!r} needs the whole path beforehand: it is measured in the modes open_loop and "
            "closed_loop only"
        )

    @abstractmethod
    def solve_recorded(self, q_curr: Array, target_pose: Array) -> Array:
        """Commands (T, dof) along one recorded episode, in rad; see `IKSolver.solve_recorded`."""


SolverFactory = Callable[..., IKSolver]
# Module of each solver of this package.
MODULES = {
    "embodik": "embodik",
    "foresight": "foresight",
    "foresight_alone": "foresight",
    "guided": "guided",
    "guided_ahead": "guided",
    "guided_kalman_0.03": "filtered",
    "guided_kalman_0.3": "filtered",
    "guided_lowpass_3": "filtered",
    "guided_lowpass_4.5": "filtered",
    "guided_lowpass_6": "filtered",
    "guided_one_euro": "filtered",
    "hold": "hold",
    "jparse": "jparse",
    "least_squares": "least_squares",
    "limit": "limit",
    "mimicik_guided": "guided",
    "mink": "mink",
    "optik": "optik",
    "pink": "pink",
    "pinocchio": "pinocchio",
    "pinocchio_undamped": "pinocchio",
    "placo": "placo",
    "placo_lerobot": "placo",
    "placo_lerobot_8": "placo",
    "pybullet": "pybullet",
    "relaxed_ik": "relaxed_ik",
    "remote": "remote",
    "ssik": "ssik",
    "undamped": "undamped",
    **dict.fromkeys(LEARNED, "mimicik"),
}
_FACTORIES: dict[str, SolverFactory] = {}
_NEEDS: dict[str, tuple[Package, ...]] = {}


def register_solver(name: str, needs: tuple[Package, ...] = ()) -> Callable[[SolverFactory], SolverFactory]:
    """Make `make_solver(name, arm, **options)` call the decorated class or function.

    Args:
        name: What users and tables call it; a class gets it as its attribute `name`.
        needs: Packages without which it cannot run; its module must be importable without them.

    Raises:
        ValueError: If another solver already has that name.
    """

    def register(factory: SolverFactory) -> SolverFactory:
        own = f"{__package__}.{MODULES[name]}" if name in MODULES else factory.__module__
        if _FACTORIES.get(name, factory) is not factory or factory.__module__ != own:
            raise ValueError(f"A solver called {name!r} is already registered.")
        if isinstance(factory, type) and issubclass(factory, IKSolver):
            factory.name = name
        _FACTORIES[name] = factory
        _NEEDS[name] = needs
        return factory

    return register


def known_solvers() -> tuple[str, ...]:
    """Names that `make_solver` takes, sorted."""
    return tuple(sorted({*MODULES, *_FACTORIES}))


def solver_configuration(name: str) -> str:
    """The `configuration` of a known solver; it need not be available."""
    return getattr(_factory(name), "configuration", "")


def _factory(name: str) -> SolverFactory:
    """What makes a known solver; its module is imported for it."""
    if name not in _FACTORIES:
        importlib.import_module(f"{__package__}.{MODULES[name]}")
    return _FACTORIES[name]


def available_solvers(names: Iterable[str] | None = None) -> dict[str, str | None]:
    """Known solvers, all of them unless named: None where its packages are here, else why it cannot run and the remedy."""
    return {name: _why_unavailable(name) for name in (known_solvers() if names is None else names)}


def _why_unavailable(name: str) -> str | None:
    _factory(name)
    try:
        for package in _NEEDS[name]:
            package.load()
    except SolverUnavailable as error:
        return str(error)
    return None


def make_solver(name: str, arm: SerialArm, **options: Any) -> IKSolver:
    """Build a solver by name for an arm.

    Args:
        name: One of `known_solvers()`.
        arm: The arm that it shall solve for.
        options: Keyword arguments of that solver.

    Raises:
        ValueError: If no solver has that name.
        SolverUnavailable: If a package or device that it needs is not here.
    """
    if name not in known_solvers():
        raise ValueError(
            f"Unknown solver {name!r}; known are {', '.join(known_solvers())}."
            + did_you_mean(name, known_solvers())
        )
    reason = _why_unavailable(name)
    if reason is not None:
        raise SolverUnavailable(f"The solver {name!r} is not available: {reason}")
    return _factory(name)(arm, **options)
