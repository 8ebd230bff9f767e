"""What a server's methods answer: arguments are checked, and long answers computed in pieces."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_mimicik.serving.limits import Limits
from lerobot_mimicik.serving.sessions import Session, SessionTable
from lerobot_mimicik.solvers.base import Array, IKSolver
from lerobot_mimicik.wire import protocol
from lerobot_mimicik.wire.protocol import BadRequestError, SolverFailedError, UnknownSessionError

_log = logging.getLogger(__name__)

# How long rows of a batch are answered before it is the next client's turn, in s: less than half a frame of a robot.
_PIECE_S = 0.02
# Rows of the first piece that a solver is asked for, and fewest and most of any: a network's pass takes some
# milliseconds for the first row and little for the others.
_FIRST_PIECE, _SHORTEST_PIECE, _LONGEST_PIECE = 16, 8, 1024
# Quaternions shorter than this are no rotation.
_SHORTEST = 1e-6


class RequestHandler:
    """The methods of the protocol, with the sessions that they keep."""

    def __init__(
        self, factories: Mapping[str, Callable[[], IKSolver]], joint_names: Sequence[str], limits: Limits
    ) -> None:
        """Build the solvers.

        Args:
            factories: What builds a solver, by the name that clients ask for.
            joint_names: Joints of the arm, in the order of its joint vector.
            limits: How much a client may use.
        """
        self.limits = limits
        self._dof = len(joint_names)
        self._sessions = SessionTable(factories, limits.max_sessions)
        self._info = {
            "joint_names": list(joint_names),
            "solvers": self._sessions.batched,
            "max_bytes": self.limits.max_bytes,
            "max_rows": self.limits.max_rows,
            "step_ranges": {
                name: None if found is None else [bound.tolist() for bound in found]
                for name, found in self._sessions.step_ranges.items()
            },
            "look_ahead": self._sessions.look_ahead,
        }
        # How many rows of each solver's answers take `_PIECE_S`, as far as it was measured.
        self._rows = dict.fromkeys(factories, _FIRST_PIECE)
        # How many arguments each takes.
        self._methods: dict[str, tuple[tuple[int, ...], Callable[..., Any]]] = {
            "info": ((0,), lambda session: self._info),
            "reset": ((2,), self._reset),
            "solve": ((2, 3), self._solve),
            "solve_recorded": ((2,), self._solve_recorded),
            "select": ((1,), self._select),
            "close": ((0,), self._sessions.close),
        }

    def answer(self, method: str, session: bytes, arguments: list[Any]) -> Any:
        """The value of the reply, or a generator that pauses after every piece of work and returns it.

        Raises:
            ServingError: The request cannot be answered; the generator raises it too.
        """
        counts, answer = self._methods.get(method, ((), None))
        if answer is None:
            raise BadRequestError(f"Unknown method {method!r}; known are {', '.join(self._methods)}.")
        if len(arguments) not in counts:
            expected = " or ".join(map(str, counts))
            raise BadRequestError(f"{method} takes {expected} arguments, got {len(arguments)}.")
        return answer(session, *arguments)

    def _reset(self, token: bytes, solver: Any, q: Any) -> bytes:
        if type(solver) is not str:
            raise BadRequestError(f"Expected the name of a solver, got {type(solver).__name__}.")
        start = self._numbers(q, "q", self._dof)
        session = self._sessions.open(token, solver)
        self._check_rows(session, start)
        self._ask(session, "reset", start)
        return session.token

    def _solve(
        self, token: bytes, q: Any, target: Any, upcoming: Any = None
    ) -> Generator[None, None, list[Any]]:
        session = self._sessions.get(token)
        q_curr, pose = self._question(q, target)
        if q_curr.ndim == 2 and not session.solver.batched:
            raise BadRequestError(
                f"{session.solver_name} takes single configurations, got {len(q_curr)} rows."
            )
        if upcoming is not None:
            following, most = self._poses(upcoming, "upcoming"), session.solver.look_ahead
            if q_curr.ndim != 1 or following.ndim != 2 or len(following) > most:
                raise BadRequestError(
                    f"upcoming: {session.solver_name} looks ahead at up to {most} targets (T, 7) for one "
                    f"configuration, got shape {following.shape} for {q_curr.shape}."
                )
            self._ask(session, "foresee", following)
        return self._commands(session, "solve_in_pieces", q_curr, pose)

    def _solve_recorded(self, token: bytes, q: Any, target: Any) -> Generator[None, None, list[Any]]:
        session = self._sessions.get(token)
        q_curr, pose = self._question(q, target)
        if q_curr.ndim != 2:
            raise BadRequestError(f"A recording is (T, {self._dof}) joints, got one configuration.")
        return self._commands(session, "recorded_in_pieces", q_curr, pose)

    def _commands(
        self, session: Session, method: str, q: Array, target: Array
    ) -> Generator[None, None, list[Any]]:
        """The solver's commands as they travel, with a pause between the pieces."""
        name, asked = session.solver_name, len(np.atleast_2d(q))
        pieces = self._ask(session, method, q, target, iter(lambda: self._rows[name], 0))
        answered: list[Array] = []
        count = 0
        while count < asked:
            if count:
                yield
                if not self._sessions.holds(session):
                    raise UnknownSessionError("The session was closed while its question was being answered.")
            begin = time.perf_counter()
            piece = self._guarded(session, method, _floats, pieces)
            if piece.shape[1:] != q.shape[-1:] or not len(piece):
                raise SolverFailedError(
                    f"{name} answered with shape {piece.shape}, expected {q.shape[-1:]} each."
                )
            count += len(piece)
            if count < asked:  # the last piece may be short, which says little of the time that rows take
                self._rows[name] = _rows_in_time(len(piece), time.perf_counter() - begin)
            answered.append(piece)
        commands = np.concatenate(answered)
        if commands.shape != np.atleast_2d(q).shape or not np.isfinite(commands).all():
            raise SolverFailedError(
                f"{session.solver_name} answered numbers that are not finite, or too many of them."
            )
        return protocol.encode_array(commands.reshape(q.shape))

    def _select(self, token: bytes, rows: Any) -> None:
        session = self._sessions.get(token)
        chosen = protocol.decode_array(rows, "rows", protocol.INDEX)
        if chosen.ndim != 1 or len(chosen) > self.limits.max_rows or (chosen < 0).any():
            raise BadRequestError(
                f"rows: expected up to {self.limits.max_rows} row numbers from 0, got shape {chosen.shape}."
            )
        self._ask(session, "select", chosen.astype(np.intp))

    def _ask(self, session: Session, method: str, *arguments: Any) -> Any:
        return self._guarded(session, method, getattr(session.solver, method), *arguments)

    def _guarded(self, session: Session, method: str, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        # A solver may raise anything; it is one client's trouble, not the server's.
        except Exception as error:
            _log.warning("%s.%s failed", session.solver_name, method, exc_info=True)
            raise SolverFailedError(
                f"{session.solver_name}.{method}: {type(error).__name__}: {error}"
            ) from error

    def _check_rows(self, session: Session, q: Array) -> None:
        if q.ndim == 2 and not session.solver.batched:
            raise BadRequestError(
                f"{session.solver_name} takes one configuration (dof,), got shape {q.shape}."
            )

    def _question(self, q: Any, target: Any) -> tuple[Array, Array]:
        """Joints and poses of a question, of one shape but for the last axis."""
        q_curr = self._numbers(q, "q", self._dof)
        pose = self._poses(target, "target")
        if q_curr.shape[:-1] != pose.shape[:-1]:
            raise BadRequestError(
                f"q has shape {q_curr.shape}, target has {pose.shape}: expected as many rows."
            )
        return q_curr, pose

    def _poses(self, item: Any, name: str) -> Array:
        """A finite (7,) or (rows, 7) array whose quaternions are rotations."""
        poses = self._numbers(item, name, 7)
        if (np.abs(poses[..., 3:]).max(axis=-1) < _SHORTEST).any():
            raise BadRequestError(f"{name}: a quaternion is shorter than {_SHORTEST}, which is no rotation.")
        return poses

    def _numbers(self, item: Any, name: str, width: int) -> Array:
        """A finite (width,) or (rows, width) array."""
        array = protocol.decode_array(item, name)
        if not array.ndim or array.shape[-1] != width or not 0 < array.size <= width * self.limits.max_rows:
            raise BadRequestError(
                f"{name}: expected shape ({width},) or (rows, {width}) with 1 to {self.limits.max_rows} rows, "
                f"got {array.shape}."
            )
        if not np.isfinite(array).all():
            raise BadRequestError(f"{name}: holds numbers that are not finite.")
        return array


def _rows_in_time(rows: int, seconds: float) -> int:
    """How many rows the next piece may have, after one of so many rows took so long; at most twice as many."""
    fitting = int(rows * _PIECE_S / max(seconds, 1e-9))
    return max(_SHORTEST_PIECE, min(fitting, 2 * rows, _LONGEST_PIECE))


def _floats(pieces: Iterator[Array]) -> Array:
    """The next piece, (n, dof); RuntimeError where there is none."""
    piece = next(pieces, None)
    if piece is None:
        raise RuntimeError("answered fewer rows than it was asked for")
    return np.atleast_2d(np.asarray(piece, dtype=float))
