"""What the interpreter must do differently while a control thread runs in it."""

from __future__ import annotations

import gc
import sys
import threading

_SWITCH_INTERVAL = 5e-4  # s
_lock = threading.Lock()
_threads = 0
_usual_interval = 0.0


def enter() -> None:
    """Call before a control thread starts; as many `leave` undo it.

    By default a thread may keep the interpreter for 5 ms, longer than a period of the control loop, and a full
    garbage collection over all that torch has imported holds up every thread for half a second. What lives now is
    left out of collections until then.
    """
    global _threads, _usual_interval
    with _lock:
        if _threads == 0:
            _usual_interval = sys.getswitchinterval()
            sys.setswitchinterval(min(_usual_interval, _SWITCH_INTERVAL))
        gc.collect()
        gc.freeze()
        _threads += 1


def leave() -> None:
    """Call when a control thread has ended."""
    global _threads
    with _lock:
        _threads -= 1
        if _threads == 0:
            sys.setswitchinterval(_usual_interval)
            gc.unfreeze()
