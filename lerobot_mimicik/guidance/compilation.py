"""The core is compiled at its first use on a machine: whether that is still to come, and a word about it."""

from __future__ import annotations

import functools
import logging
from pathlib import Path

from lerobot_mimicik.guidance.descent import descend

_log = logging.getLogger(__name__)


def is_compiled(cache: str | Path | None = None) -> bool:
    """Whether the core is in numba's cache of this machine, or in the folder `cache`; where nothing is compiled, it is."""
    compiled = getattr(descend, "stats", None)
    if compiled is None:  # NUMBA_DISABLE_JIT
        return True
    return any(Path(cache or str(compiled.cache_path)).glob("descent.descend-*.nbi"))


@functools.cache
def announce_compilation() -> None:
    """Say, once in a process, that the first call takes long, where it does."""
    if not is_compiled():
        _log.warning("Compiling the guided solver for this machine, once: this takes a minute.")
