"""Inverse-kinematics solvers behind one interface: `make_solver(name, arm, **options)`.

A new solver is a module here that subclasses `IKSolver` and registers itself, and a line in `base.MODULES`. A
solver's module is imported when it is asked for, and peers that live in packages of their own when they are made:
`available_solvers()` says which are here.
"""

from lerobot_mimicik.solvers.availability import SolverUnavailable
from lerobot_mimicik.solvers.base import (
    IKSolver,
    available_solvers,
    known_solvers,
    make_solver,
    register_solver,
    solver_configuration,
)

__all__ = [
    "IKSolver",
    "SolverUnavailable",
    "available_solvers",
    "known_solvers",
    "make_solver",
    "register_solver",
    "solver_configuration",
]
