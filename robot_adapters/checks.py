"""What a read-only check of an installation or an arm ends with, and the checks that an arm's driver has."""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol


class CheckOutcome(enum.StrEnum):
    """How a check ended."""

    OK = "ok"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Finding:
    """One check: its name, how it ended, what was seen, and what to do where it failed."""

    check: str
    outcome: CheckOutcome
    detail: str
    remedy: str = ""


class CheckFailed(Exception):  # noqa: N818 - the outcome of a check, not an error of the program
    """A check did not pass: what was seen, and the remedy."""

    def __init__(self, detail: str, remedy: str) -> None:
        super().__init__(detail)
        self.detail, self.remedy = detail, remedy


@dataclass(frozen=True)
class Check:
    """A check by its name: `run` says what it saw or raises; it is skipped where the check it `needs` did not pass."""

    name: str
    run: Callable[[], str]
    needs: str = ""


class ArmChecks(Protocol):
    """The checks of one arm on its bus; nothing is enabled, moved or written."""

    def checks(self) -> Sequence[Check]:
        """In the order in which they run; after the one called "motors" the joints are known."""
        ...

    def joints(self) -> list[float]:
        """The measured joints [rad], once the checks have passed."""
        ...

    def close(self) -> None:
        """Let go of the bus."""
        ...
