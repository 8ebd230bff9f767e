"""Why a configuration is refused, told to the user of LeRobot's commands too.

LeRobot parses command lines and configuration files with draccus, which replaces a ValueError from a `__post_init__`
by "Couldn't instantiate class ... using the given arguments". It passes its own DecodingError on, and LeRobot prints
that. In Python a wrong value stays a ValueError.
"""

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from numbers import Integral, Real
from typing import Any

from draccus.utils import DecodingError

_PARSER = "draccus.parsers.decoding"
_EXPECTED: dict[Any, tuple[Callable[[Any], bool], str]] = {
    bool: (lambda value: isinstance(value, bool), "true or false"),
    int: (lambda value: isinstance(value, Integral) and not isinstance(value, bool), "a whole number"),
    float: (lambda value: _is_number(value) and math.isfinite(value), "a number"),
    str: (lambda value: isinstance(value, str), "text"),
}


@contextmanager
def reasons_for_users() -> Iterator[None]:
    """Around the checks of a `__post_init__`.

    Raises:
        DecodingError: In place of a ValueError or TypeError, with its message, where draccus is parsing.
    """
    try:
        yield
    except (TypeError, ValueError) as error:
        if not _parsing():
            raise
        raise DecodingError((), str(error)) from error


def check_types(config: Any) -> None:
    """Refuses values of the wrong type in a dataclass's plain fields, and numbers that are not finite.

    Raises:
        ValueError: Names the field, its value and what was expected.
    """
    for field in fields(config):
        if field.type not in _EXPECTED:
            continue
        fits, words = _EXPECTED[field.type]
        value = getattr(config, field.name)
        if not fits(value):
            raise ValueError(f"{field.name}={value!r}: expected {words}")


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _parsing() -> bool:
    """Whether draccus is among the callers."""
    frame = sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
        if frame.f_globals.get("__name__") == _PARSER:
            return True
    return False
