"""Names in error messages: those that exist, and the one that a mistyped one was meant to be."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def listed(names: Iterable[str]) -> str:
    """Names for an error message: comma-separated, `(none)` when there are none."""
    return ", ".join(names) or "(none)"


def shortened(names: Iterable[str], count: int = 20) -> str:
    """`listed`, with the number of those left out after the first `count`."""
    all_names = list(names)
    rest = len(all_names) - count
    return listed(all_names[:count]) + (f", and {rest} more" if rest > 0 else "")


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """The known name that a mistyped one is most like, to end a message with: ` Did you mean guided?`; or nothing."""
    by_letters = {name.lower(): name for name in known}
    found = difflib.get_close_matches(given.lower(), by_letters, n=1)
    return f" Did you mean {by_letters[found[0]]}?" if found else ""
