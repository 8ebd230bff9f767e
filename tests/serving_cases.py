"""What the tests of the serving package share: a server in a thread, and solvers that remember and fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import ClassVar

import numpy as np
from evaluation_cases import airbot

from lerobot_mimicik.serving.server import IKServer
from lerobot_mimicik.solvers import IKSolver, make_solver

HOME = np.array([0.1, -0.4, 0.6, 0.2, 0.3, -0.1])
POSE = np.array([0.3, 0.1, 0.2, 0.0, 0.0, 0.0, 1.0])


class Counting(IKSolver):
    """Answers the joints plus the number of questions since `reset`, so that its history shows."""

    name = "counting"
    batched = True

    def reset(self, q):
        self.seen = np.zeros(len(np.atleast_2d(q)))

    def solve(self, q_curr, target_pose):
        self.seen = self.seen + 1
        return q_curr + (self.seen[:, None] if q_curr.ndim == 2 else self.seen)

    def select(self, rows):
        self.seen = self.seen[rows]


class Single(Counting):
    """The same for one configuration at a time."""

    batched = False


class Failing(Single):
    """Can do nothing."""

    def solve(self, q_curr, target_pose):
        raise ZeroDivisionError("no way there")


class Waiting(Single):
    """Answers only once `gate` is open."""

    gate = threading.Event()

    def solve(self, q_curr, target_pose):
        self.gate.wait(300)
        return super().solve(q_curr, target_pose)


class Busy(Single):
    """Takes its time over recordings until somebody else has been served."""

    somebody = threading.Event()

    def solve(self, q_curr, target_pose):
        self.somebody.wait(0.01)
        return super().solve(q_curr, target_pose)


class Noticing(Single):
    """Somebody else: `Busy` goes on once this one is asked."""

    def solve(self, q_curr, target_pose):
        Busy.somebody.set()
        return super().solve(q_curr, target_pose)


class Slow(Counting):
    """Takes at least 2 ms for a row; keeps how many rows it was asked for at once."""

    pieces: ClassVar[list[int]] = []

    def solve_in_pieces(self, q_curr, target_pose, rows):
        start = 0
        for most in rows:
            if start >= len(q_curr):
                return
            piece = q_curr[start : start + most]
            time.sleep(0.002 * len(piece))
            self.pieces.append(len(piece))
            yield piece
            start += most


class Undefined(Counting):
    """Answers not a number, in the second row where there is one."""

    def solve(self, q_curr, target_pose):
        answer = q_curr.copy()
        answer[-1] = np.nan
        return answer


FACTORIES = {
    "hold": partial(make_solver, "hold", airbot()),
    "counting": Counting,
    "single": Single,
    "failing": Failing,
    "waiting": Waiting,
    "busy": Busy,
    "noticing": Noticing,
    "slow": Slow,
    "undefined": Undefined,
}


@contextmanager
def serving(factories=FACTORIES, **options) -> Iterator[IKServer]:
    """A server on a free port of loopback, answering in a thread of its own."""
    options = {"bind": "tcp://127.0.0.1:0"} | options
    with IKServer(factories, airbot().joint_names, **options) as server:
        thread = threading.Thread(target=server.serve)
        thread.start()
        try:
            yield server
        finally:
            server.stop()
            thread.join(30)
            assert not thread.is_alive()
