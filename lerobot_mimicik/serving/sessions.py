"""Sessions of a server: each has a solver of its own, so that no client sees another one's history."""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from lerobot_mimicik.solvers.base import IKSolver
from lerobot_mimicik.wire.protocol import BadRequestError, UnknownSessionError


@dataclass(frozen=True)
class Session:
    """One client's use of one solver. The token cannot be guessed: who has it may use the session."""

    token: bytes
    solver_name: str
    solver: IKSolver


class SessionTable:
    """At most `max_sessions` sessions; to open one more, that idle for longest is dropped."""

    def __init__(self, factories: Mapping[str, Callable[[], IKSolver]], max_sessions: int) -> None:
        """Builds one solver of each name at once, so that one that cannot be built is no client's surprise."""
        self._factories = dict(factories)
        self._max_sessions = max_sessions
        # Solvers without a session. Every session begins with a reset, after which a used one is as new.
        self._spare = {name: [factory()] for name, factory in self._factories.items()}
        self.batched = {name: solvers[0].batched for name, solvers in self._spare.items()}
        self.step_ranges = {name: solvers[0].step_range for name, solvers in self._spare.items()}
        self.look_ahead = {name: solvers[0].look_ahead for name, solvers in self._spare.items()}
        self._sessions: OrderedDict[bytes, Session] = OrderedDict()

    def __len__(self) -> int:
        return len(self._sessions)

    def open(self, token: bytes, solver_name: str) -> Session:
        """The session `token` if it exists and is one of that solver, else a new one.

        Raises:
            BadRequestError: If no solver has that name.
        """
        if solver_name not in self._factories:
            raise BadRequestError(
                f"Unknown solver {solver_name!r}; this server has {', '.join(sorted(self._factories))}."
            )
        session = self._sessions.get(token)
        if session is not None and session.solver_name == solver_name:
            self._sessions.move_to_end(token)
            return session
        if session is not None:
            self.close(token)
        elif len(self._sessions) >= self._max_sessions:
            self.close(next(iter(self._sessions)))
        spare = self._spare[solver_name]
        solver = spare.pop() if spare else self._factories[solver_name]()
        session = Session(secrets.token_bytes(16), solver_name, solver)
        self._sessions[session.token] = session
        return session

    def holds(self, session: Session) -> bool:
        """Whether a session is still open: else its solver may be another session's by now."""
        return self._sessions.get(session.token) is session

    def get(self, token: bytes) -> Session:
        """The session `token`, which then is the one used last.

        Raises:
            UnknownSessionError: If there is none; the message says why that may be.
        """
        session = self._sessions.get(token)
        if session is None:
            raise UnknownSessionError(
                "No such session: it was closed, or the server was started anew, or it was the one idle for "
                f"longest when more than {self._max_sessions} were wanted. reset(q) opens a new one."
            )
        self._sessions.move_to_end(token)
        return session

    def close(self, token: bytes) -> None:
        """Drop a session; its solver is kept for another one. Nothing happens if it does not exist."""
        session = self._sessions.pop(token, None)
        if session is not None:
            self._spare[session.solver_name].append(session.solver)
