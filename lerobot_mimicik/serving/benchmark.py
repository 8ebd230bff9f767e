"""What asking a server costs compared with asking the solver here: latency of one client, rate of several."""

from __future__ import annotations

import multiprocessing
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import zmq

from lerobot_mimicik.serving import protocol
from lerobot_mimicik.serving.client import IKClient

if TYPE_CHECKING:
    from multiprocessing.synchronize import Barrier

    from lerobot_mimicik.solvers.base import Array, IKSolver


@dataclass(frozen=True)
class LatencyComparison:
    """Durations of single queries, in ms.

    Attributes:
        local_ms, remote_ms: Medians over all queries, here and from the server.
        remote_p99_ms: The server's 99th percentile.
        calmest_ms: The median of the server's fastest turn: on a machine with other work, nearer to what
            the server itself takes.
    """

    local_ms: float
    remote_ms: float
    remote_p99_ms: float
    calmest_ms: float


def compare_latency(
    local: IKSolver, remote: IKSolver, q: Array, target: Array, rounds: int, queries: int = 500
) -> LatencyComparison:
    """Ask both about single configurations, in turns so that both see the machine alike.

    Args:
        local, remote: The solver here, and the same behind a server.
        q, target: The question, (dof,) and (7,).
        rounds: How often each gets its turn, after one turn that is not counted.
        queries: Queries in a turn.
    """
    milliseconds = np.empty((2, rounds + 1, queries))
    for turn in range(rounds + 1):
        for label, solver in enumerate((local, remote)):
            solver.reset(q)
            for i in range(queries):
                begin = time.perf_counter()
                solver.solve(q, target)
                milliseconds[label, turn, i] = 1e3 * (time.perf_counter() - begin)
    here, there = milliseconds[:, 1:]
    return LatencyComparison(
        float(np.median(here)),
        float(np.median(there)),
        float(np.percentile(there, 99)),
        float(np.median(there, axis=1).min()),
    )


def local_rate(solver: IKSolver, q: Array, target: Array, seconds: float) -> float:
    """Single queries a second that the solver answers here."""
    solver.reset(q)
    count, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        solver.solve(q, target)
        count += 1
    return count / (time.perf_counter() - begin)


def remote_rate(
    address: str, solver: str, q: Array, target: Array, seconds: float, clients: int, window: int
) -> float:
    """Single queries a second of several client processes together.

    Args:
        address, solver: The server and its solver.
        q, target: The question, (dof,) and (7,).
        seconds: How long to ask.
        clients: Processes that ask, each over its own connection and session.
        window: Requests that each has under way at a time; 1 waits for every answer.

    Raises:
        RuntimeError: If a client fails.
    """
    spawn = multiprocessing.get_context("spawn")
    barrier, counts = spawn.Barrier(clients + 1), spawn.Queue()
    processes = [
        spawn.Process(target=_ask_on, args=(address, solver, q, target, seconds, window, barrier, counts))
        for _ in range(clients)
    ]
    for process in processes:
        process.start()
    try:
        barrier.wait(timeout=120)
        rates = [counts.get(timeout=seconds + 60) for _ in processes]
    except Exception as error:
        raise RuntimeError(f"A client of the benchmark failed: {error!r}.") from error
    finally:
        for process in processes:
            process.join(timeout=10)
            if process.is_alive():
                process.kill()
    return float(sum(rates))


def _ask_on(
    address: str,
    solver: str,
    q: Array,
    target: Array,
    seconds: float,
    window: int,
    barrier: Barrier,
    counts: multiprocessing.Queue[float],
) -> None:
    """One client process: keep `window` requests under way for `seconds`, and report answers a second."""
    with IKClient(address, solver, timeout_s=20.0) as client:
        client.reset(q)
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        with socket:
            socket.linger = 0
            socket.rcvtimeo = 20_000
            socket.connect(address)
            sent = received = 0
            barrier.wait(timeout=120)
            begin = time.perf_counter()
            while (passed := time.perf_counter() - begin) < seconds or received < sent:
                while sent - received < window and passed < seconds:
                    sent += 1
                    question = (protocol.encode_array(q), protocol.encode_array(target))
                    socket.send(protocol.pack_request(sent, "solve", client.session, question))
                number, value = protocol.unpack_reply(socket.recv())
                received += 1
                if number != received or isinstance(value, protocol.ServingError):
                    raise RuntimeError(f"Request {received} was answered as {number}: {value}")
                protocol.decode_array(value, "answer")
            counts.put(received / (time.perf_counter() - begin))
