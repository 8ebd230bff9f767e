"""The IK server: one ROUTER socket, one thread, a solver for every session.

Requests wait in a queue for each client. The clients take turns; a turn is one piece of an answer: a whole one, or as
many rows of a long one as `requests` answers at once. So nobody waits longer for a short answer than one piece of every
other client's takes.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Generator, Mapping, Sequence
from types import TracebackType

import zmq
from zmq.auth.thread import ThreadAuthenticator

from lerobot_mimicik.serving.limits import Limits, RateLimiter
from lerobot_mimicik.serving.requests import RequestHandler
from lerobot_mimicik.solvers.base import IKSolver
from lerobot_mimicik.wire import protocol
from lerobot_mimicik.wire.protocol import BadRequestError, RateExceededError, ServingError
from lerobot_mimicik.wire.security import ZAP_DOMAIN, ServerKeys, check_allowed, is_local, secure_server

# How long `serve` may take to notice `stop`, in ms.
_STOP_MS = 100
# Requests that ZeroMQ keeps for one client before its connection is told to wait.
_QUEUE = 256
_HEARTBEAT_MS = 10_000
# Messages read between two turns, so that who sends without end keeps nobody from being answered.
_INTAKE = 64

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
        self._requests = RequestHandler(factories, joint_names, self.limits)
        self._rates = RateLimiter(self.limits.rate, self.limits.burst)
        # Jobs of each client, with the address that the reply goes to; the client whose turn is next comes first.
        self._waiting: OrderedDict[bytes | str, deque[tuple[bytes, _Job]]] = OrderedDict()
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
            value = self._requests.answer(method, session, arguments)
            if isinstance(value, Generator):
                value = yield from value
            reply = protocol.pack_reply(number, value)
        except ServingError as error:
            self.refused += 1
            return protocol.pack_error(number, error)
        self.answered += 1
        return reply


def _number(frames: list[bytes]) -> bytes:
    """The id of a request, also of one that is none."""
    return frames[-1][: protocol.ID_BYTES].ljust(protocol.ID_BYTES, b"\0")
