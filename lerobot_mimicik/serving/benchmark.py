"""What asking a server costs compared with asking the solver here: latency of one client, rate of several, and how
much one waits while another asks for long batches.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from queue import Empty
from threading import BrokenBarrierError
from typing import TYPE_CHECKING, Any

import numpy as np
import zmq

from lerobot_mimicik.solvers.remote_client import IKClient
from lerobot_mimicik.wire import protocol

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess
    from multiprocessing.synchronize import Barrier

    from lerobot_mimicik.solvers.base import Array, IKSolver

_PATIENCE_S = 120.0  # with processes that start on a busy machine


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


@dataclass(frozen=True)
class Waiting:
    """Durations of single queries, in ms, alone and while another client sends batches.

    Attributes:
        alone_ms, alone_max_ms: Median and longest without the other client.
        beside_ms, beside_p99_ms, beside_max_ms: Median, 99th percentile and longest beside it.
        queries: Number of queries beside it.
        rows_per_s: Rows of the other client's batches that were answered in a second.
    """

    alone_ms: float
    alone_max_ms: float
    beside_ms: float
    beside_p99_ms: float
    beside_max_ms: float
    queries: int
    rows_per_s: float


def waiting_beside_batches(
    address: str, solver: str, q: Array, target: Array, seconds: float, rows: int, pause_s: float = 0.05
) -> Waiting:
    """Ask single queries as a robot does, first alone, then while another process asks for batch after batch.

    Args:
        address, solver: The server and its solver, which both clients ask.
        q, target: The question, (dof,) and (7,); a batch is a recording that repeats it.
        seconds: How long to ask, each time.
        rows: Frames of a recording.
        pause_s: Between two single queries.

    Raises:
        RuntimeError: If the other client fails.
    """
    recording = np.tile(q, (rows, 1)), np.tile(target, (rows, 1))
    with IKClient(address, solver, timeout_s=20.0) as client:
        client.reset(q)
        client.solve(q, target)  # a policy traces its network first
        alone = _durations(client, q, target, seconds, pause_s)
        with _asking(1, (address, solver, "solve_recorded", *recording, seconds, 2)) as rates:
            beside = _durations(client, q, target, seconds, pause_s)
            (rate,) = rates()
    return Waiting(
        float(np.median(alone)),
        max(alone),
        float(np.median(beside)),
        float(np.percentile(beside, 99)),
        max(beside),
        len(beside),
        rate * rows,
    )


def _durations(client: IKClient, q: Array, target: Array, seconds: float, pause_s: float) -> list[float]:
    """Of single queries for so long, in ms."""
    found = []
    until = time.perf_counter() + seconds
    while (begin := time.perf_counter()) < until:
        client.solve(q, target)
        found.append(1e3 * (time.perf_counter() - begin))
        time.sleep(pause_s)
    return found


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
    with _asking(clients, (address, solver, "solve", q, target, seconds, window)) as rates:
        return float(sum(rates()))


@contextmanager
def _asking(clients: int, arguments: tuple[Any, ...]) -> Iterator[Callable[[], list[float]]]:
    """Client processes of `_ask_on` that have begun; what is yielded waits for the rate of each.

    Raises:
        RuntimeError: If one fails.
    """
    spawn = multiprocessing.get_context("spawn")
    barrier, counts = spawn.Barrier(clients + 1), spawn.Queue()
    processes = [spawn.Process(target=_ask_on, args=(*arguments, barrier, counts)) for _ in range(clients)]
    for process in processes:
        process.start()
    try:
        barrier.wait(timeout=_PATIENCE_S)
        yield partial(_answers, counts, processes)
    except BrokenBarrierError as error:
        raise RuntimeError(f"A client of the benchmark failed: {error!r}.") from error
    finally:
        for process in processes:
            process.join(timeout=10)
            if process.is_alive():
                process.kill()


def _answers(counts: multiprocessing.Queue[float], processes: Sequence[BaseProcess]) -> list[float]:
    """What every process reports; RuntimeError as soon as one has failed."""
    found: list[float] = []
    until = time.monotonic() + _PATIENCE_S
    while len(found) < len(processes):
        try:
            found.append(counts.get(timeout=0.5))
        except Empty:
            if any(process.exitcode for process in processes) or time.monotonic() > until:
                raise RuntimeError("A client of the benchmark failed; what it said is above.") from None
    return found


def _ask_on(
    address: str,
    solver: str,
    method: str,
    q: Array,
    target: Array,
    seconds: float,
    window: int,
    barrier: Barrier,
    counts: multiprocessing.Queue[float],
) -> None:
    """One client process: keep `window` requests under way for `seconds`, and report answers a second.

    `method` is the protocol's, `solve` or `solve_recorded`; `q` and `target` are its arguments.
    """
    with IKClient(address, solver, timeout_s=20.0) as client:
        client.reset(q if q.ndim == 1 else q[0])
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        with socket:
            socket.linger = 0
            socket.rcvtimeo = int(1e3 * _PATIENCE_S)
            socket.connect(address)
            sent = received = 0
            barrier.wait(timeout=_PATIENCE_S)
            begin = time.perf_counter()
            while (passed := time.perf_counter() - begin) < seconds or received < sent:
                while sent - received < window and passed < seconds:
                    sent += 1
                    question = (protocol.encode_array(q), protocol.encode_array(target))
                    socket.send(protocol.pack_request(sent, method, client.session, question))
                number, value = protocol.unpack_reply(socket.recv())
                received += 1
                if number != received or isinstance(value, protocol.ServingError):
                    raise RuntimeError(f"Request {received} was answered as {number}: {value}")
                protocol.decode_array(value, "answer")
            counts.put(received / (time.perf_counter() - begin))
