"""The IK server: one ROUTER socket, one thread, a solver for every session.

Requests wait in a queue for each client. The clients take turns; a turn is one piece of an answer: a whole one, or as
many rows of a long one as take `_PIECE_S`. So nobody waits longer for a short answer than one piece of every other
client's takes.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any

import numpy as np
import zmq
from zmq.auth.thread import ThreadAuthenticator

from lerobot_mimicik.serving.limits import Limits, RateLimiter
from lerobot_mimicik.serving.sessions import Session, SessionTable
from lerobot_mimicik.solvers.base import Array, IKSolver
from lerobot_mimicik.wire import protocol
from lerobot_mimicik.wire.protocol import (
    BadRequestError,
    RateExceededError,
    ServingError,
    SolverFailedError,
    UnknownSessionError,
)
from lerobot_mimicik.wire.security import ZAP_DOMAIN, ServerKeys, check_allowed, is_local, secure_server

_log = logging.getLogger(__name__)

# How long `serve` may take to notice `stop`, in ms.
_STOP_MS = 100
# Requests that ZeroMQ keeps for one client before its connection is told to wait.
_QUEUE = 256
_HEARTBEAT_MS = 10_000
# How long rows of a batch are answered before it is the next client's turn, in s: less than half a frame of a robot.
_PIECE_S = 0.02
# Rows of the first piece that a solver is asked for, and fewest and most of any: a network's pass takes some
# milliseconds for the first row and little for the others.
_FIRST_PIECE, _SHORTEST_PIECE, _LONGEST_PIECE = 16, 8, 1024
# Messages read between two turns, so that who sends without end keeps nobody from being answered.
_INTAKE = 64
# Quaternions shorter than this are no rotation.
_SHORTEST = 1e-6

_Job = Generator[None, None, bytes]


class IKServer:
    """Answers requests of the protocol until it is stopped.

    Clients take turns, so that long questions of one do not hold up the short ones of others.

    Bound to anything but loopback or ipc it demands keys. A request that cannot be answered is answered
    with an error, and the server goes on. `serve` runs in one thread, any one; `stop` may be called from
    others and from signal handlers.

    Clients are told apart by their key where there are keys, else by their connection.

    Attributes:
        address: Where it listens, with the port that was chosen if the given one was 0 or `*`.
        answered, refused: Number of requests so far that got an answer, and an error.
    """

    def __init__(
        self,
        factories: Mapping[str, Callable[[], IKSolver]],
        joint_names: Sequence[str],
        bind: str = "tcp://127.0.0.1:5555",
        limits: Limits | None = None,
        keys: ServerKeys | None = None,
    ) -> None:
        """Build the solvers and begin to listen; questions are answered by `serve`.

        Args:
            factories: What builds a solver, by the name that clients ask for.
            joint_names: Joints of the arm, in the order of its joint vector.
            bind: `tcp://HOST:PORT` or `ipc://PATH`.
            limits: How much a client may use; None: the defaults.
            keys: Own key and allowed clients; None: no encryption, for local addresses only.

        Raises:
            ValueError: If there is no solver, or `bind` can be reached from outside and there are no keys.
            OSError: If the address cannot be had, or a key file is missing.
        """
        if not factories:
            raise ValueError("A server needs at least one solver.")
        if not is_local(bind) and keys is None:
            raise ValueError(
                f"{bind} can be reached from other computers, so the server must have keys: its own secret key "
                "and a folder of the public keys of allowed clients. Without keys it serves "
                "tcp://127.0.0.1:PORT or ipc://PATH only."
            )
        self.limits = limits or Limits()
        self.answered = self.refused = 0
        self._dof = len(joint_names)
        self._sessions = SessionTable(factories, self.limits.max_sessions)
        self._rates = RateLimiter(self.limits.rate, self.limits.burst)
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
        # Jobs of each client, with the address that the reply goes to; the client whose turn is next comes first.
        self._waiting: OrderedDict[bytes | str, deque[tuple[bytes, _Job]]] = OrderedDict()
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
        self._stopping = threading.Event()
        self._keyed = keys is not None
        # A context of its own: who may connect is decided once for a context.
        self._context = zmq.Context()
        self._authenticator: ThreadAuthenticator | None = None
        self._socket = self._context.socket(zmq.ROUTER)
        try:
            self._listen(bind, keys)
        except BaseException:
            self.close()
            raise
        self.address = str(bytes(self._socket.getsockopt(zmq.LAST_ENDPOINT)), "utf-8").rstrip("\0")

    def _listen(self, bind: str, keys: ServerKeys | None) -> None:
        socket = self._socket
        socket.linger = 0
        socket.rcvtimeo = _STOP_MS
        socket.rcvhwm = socket.sndhwm = _QUEUE
        socket.maxmsgsize = 2 * self.limits.max_bytes
        socket.heartbeat_ivl = _HEARTBEAT_MS
        socket.ipv6 = "[" in bind
        if keys is not None:
            check_allowed(keys.allowed_keys)
            secure_server(socket, keys)
            self._authenticator = ThreadAuthenticator(self._context)
            self._authenticator.start()
            self._authenticator.configure_curve(ZAP_DOMAIN, keys.allowed_keys)
        try:
            socket.bind(bind)
        except zmq.ZMQError as error:
            raise OSError(f"Cannot listen on {bind}: {error}.") from error

    def serve(self) -> None:
        """Answer until `stop` is called, from wherever; returns at once if it was called before."""
        while not self._stopping.is_set():
            self._take_in()
            self._take_turn()

    def _take_in(self) -> None:
        """Put the messages that have arrived into their clients' queues; wait for one where nothing is to do."""
        for _ in range(_INTAKE):
            try:
                client, frames = self._receive(zmq.NOBLOCK if self._waiting else 0)
            except zmq.Again:
                return
            queue = self._waiting.setdefault(client, deque())
            if len(queue) < self.limits.max_waiting:
                queue.append((frames[0], self._reply(client, frames)))
                continue
            self.refused += 1
            error = RateExceededError(
                f"More than {self.limits.max_waiting} requests are waiting; wait for answers before asking more."
            )
            self._socket.send_multipart([frames[0], protocol.pack_error(_number(frames), error)])

    def _take_turn(self) -> None:
        """One piece of work for the client whose turn it is."""
        if not self._waiting:
            return
        client, queue = next(iter(self._waiting.items()))
        address, job = queue[0]
        try:
            next(job)
        except StopIteration as finished:
            queue.popleft()
            # Without a free place in the client's queue the reply is lost, as is a client that reads none.
            self._socket.send_multipart([address, finished.value])
        self._waiting.move_to_end(client)
        if not queue:
            del self._waiting[client]

    def stop(self) -> None:
        """Make `serve` return within a tenth of a second, or after the piece of work that it is at."""
        self._stopping.set()

    def close(self) -> None:
        """Stop listening and free everything, after `serve` has returned; a second call does nothing."""
        self._stopping.set()
        self._socket.close(0)
        if self._authenticator is not None:
            self._authenticator.stop()
            self._authenticator = None
        self._context.term()

    def __enter__(self) -> IKServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _receive(self, flags: int) -> tuple[bytes | str, list[bytes]]:
        """Who sent the next message, and its frames; the first is where the reply goes."""
        if not self._keyed:
            frames = self._socket.recv_multipart(flags)
            return frames[0], frames
        keyed_frames = self._socket.recv_multipart(flags, copy=False)
        # The authenticator calls a client by its public key.
        return str(keyed_frames[-1].get("User-Id")), [frame.bytes for frame in keyed_frames]

    def _reply(self, client: bytes | str, frames: list[bytes]) -> _Job:
        """What to send for one message, whatever it is, with a pause after every piece of work."""
        message, number = frames[-1], _number(frames)
        try:
            if not self._rates.allows(client, time.monotonic()):
                raise RateExceededError(f"More than {self.limits.rate:g} requests a second; ask more slowly.")
            if len(frames) != 2:
                raise BadRequestError(f"Expected a message of one frame, got {len(frames) - 1}.")
            if len(message) > self.limits.max_bytes:
                raise BadRequestError(
                    f"The request has {len(message)} bytes, the server takes {self.limits.max_bytes}."
                )
            method, session, arguments = protocol.unpack_request(message)
            value = self._answer(method, session, arguments)
            if isinstance(value, Generator):
                value = yield from value
            reply = protocol.pack_reply(number, value)
        except ServingError as error:
            self.refused += 1
            return protocol.pack_error(number, error)
        self.answered += 1
        return reply

    def _answer(self, method: str, session: bytes, arguments: list[Any]) -> Any:
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


def _number(frames: list[bytes]) -> bytes:
    """The id of a request, also of one that is none."""
    return frames[-1][: protocol.ID_BYTES].ljust(protocol.ID_BYTES, b"\0")


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
