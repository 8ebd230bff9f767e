"""Inverse-kinematics solvers behind one interface: ``make_solver(name, arm, **options)``.

A new solver is a module here that subclasses ``IKSolver`` and registers itself, and a line below.
"""

from lerobot_mimicik.solvers import hold, mimicik, remote
from lerobot_mimicik.solvers.base import IKSolver, known_solvers, make_solver, register_solver

__all__ = ["IKSolver", "hold", "known_solvers", "make_solver", "mimicik", "register_solver", "remote"]
