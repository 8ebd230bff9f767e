"""Packages that a solver needs: whether they are here, and what to do when they are not."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from types import ModuleType


class SolverUnavailable(RuntimeError):  # noqa: N818 - a state of the machine more than a mistake
    """A solver that is known but cannot run here; the message gives the reason and the remedy."""


@dataclass(frozen=True)
class Package:
    """A Python package outside the project's own dependencies.

    Attributes:
        module: What is imported.
        remedy: What the user can do to get it, as the end of "... is not installed: ".
    """

    module: str
    remedy: str

    def load(self) -> ModuleType:
        """The imported module.

        Raises:
            SolverUnavailable: If it is not installed, or is installed and cannot be imported.
        """
        top = self.module.partition(".")[0]
        try:
            return importlib.import_module(self.module)
        except ModuleNotFoundError as error:
            if error.name != top:
                raise SolverUnavailable(f"the package {top} lacks {error.name}: {self.remedy}") from error
            raise SolverUnavailable(f"the package {top} is not installed: {self.remedy}") from error
        except ImportError as error:
            raise SolverUnavailable(
                f"the package {top} is installed but cannot be imported ({error}): {self.remedy}"
            ) from error


def from_extra(module: str, extra: str = "bench") -> Package:
    """A package that one of the project's extras brings."""
    return Package(module, f"uv pip install 'lerobot_policy_mimicik[{extra}]'")
