"""`mimicik benchmark-server`: what asking `mimicik serve` costs, and how long one client waits for another's batches."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from lerobot_mimicik.cli.eval import PolicySource
from lerobot_mimicik.cli.options import parse, say_loading

HELP = "Measure the latency that the IK server adds, its queries a second, and the waiting beside a client with batches."

_MOST_CLIENTS = 64  # processes, as many as the server keeps sessions by default


@dataclass
class BenchmarkServerConfig:
    """Starts a server of its own on loopback, asks it and the solver in this process, and compares."""

    policy: PolicySource = field(default_factory=PolicySource)
    # The solver that is asked; the fastest shows the server's own cost. Those of a checkpoint need --policy.path.
    solver: str = "hold"
    # A shipped arm, or the path of a URDF.
    arm: str = "airbot_play"
    # Address of the server that is started; port 0 is a free one.
    bind: str = "tcp://127.0.0.1:0"
    # Turns of 500 single queries each, for the latency.
    rounds: int = 10
    # How long the rate is measured, in s, each time.
    seconds: float = 4.0
    # Processes that ask at the same time, for the rate.
    clients: int = 2
    # Requests that each has under way, at most as many as the server lets wait.
    window: int = 16
    # Frames of the recordings that a second client sends, two at a time, while single queries are timed.
    batch_rows: int = 4096


def main(argv: Sequence[str]) -> int:
    """Parse the command line, measure and print."""
    config = parse(BenchmarkServerConfig, argv, "mimicik benchmark-server")
    from lerobot_mimicik.cli.serve import ServeConfig, check_paths, solvers_of
    from lerobot_mimicik.serving.limits import Limits
    from lerobot_mimicik.wire.security import is_local

    _check_numbers(config, Limits().max_waiting, Limits().max_rows)
    if not is_local(config.bind):
        raise ValueError(
            f"--bind={config.bind}: expected an address of this computer, such as tcp://127.0.0.1:0"
        )
    served = ServeConfig(policy=config.policy, solvers=config.solver, arm=config.arm)
    check_paths(served)
    say_loading()
    import torch

    from lerobot_mimicik.serving.benchmark import (
        compare_latency,
        local_rate,
        remote_rate,
        waiting_beside_batches,
    )
    from lerobot_mimicik.solvers.remote_client import IKClient

    arm, factories = solvers_of(served)
    solver = factories[config.solver]()
    q = (0.5 * (arm.lower + arm.upper)).clamp(-1.0, 1.0).numpy()
    target = arm.forward(torch.from_numpy(q)).numpy()
    with _server(config) as address:
        with IKClient(address, config.solver, arm.joint_names, timeout_s=20.0) as client:
            latency = compare_latency(solver, client, q, target, config.rounds)
        here = local_rate(solver, q, target, config.seconds)
        one = remote_rate(address, config.solver, q, target, config.seconds, clients=1, window=1)
        many = remote_rate(address, config.solver, q, target, config.seconds, config.clients, config.window)
        waiting = waiting_beside_batches(address, config.solver, q, target, config.seconds, config.batch_rows)
    ratio, load = latency.remote_ms / latency.local_ms, os.getloadavg()[0]
    print(f"solver {config.solver}, {os.cpu_count()} CPUs, load {load:.1f}, {address}")
    print("single queries, one at a time                    p50 ms     p99 ms")
    print(f"  in this process                            {latency.local_ms:10.4f}")
    print(
        f"  from the server                            {latency.remote_ms:10.4f} {latency.remote_p99_ms:10.4f}"
    )
    print(f"  added by the server                        {latency.remote_ms - latency.local_ms:10.4f}")
    print(f"  added in the calmest of the turns          {latency.calmest_ms - latency.local_ms:10.4f}")
    print(f"  ratio, server to this process              {ratio:10.1f}")
    print("single queries a second                        number      ratio")
    print(f"  in this process                            {here:10,.0f} {1:10.3f}")
    print(f"  one client, waiting for every answer       {one:10,.0f} {one / here:10.3f}")
    label = f"{config.clients} clients with {config.window} under way"
    print(f"  {label:<42} {many:10,.0f} {many / here:10.3f}")
    print("single queries of a robot at 20 Hz               p50 ms     p99 ms     max ms")
    print(
        f"  alone                                      {waiting.alone_ms:10.2f} {'':10} {waiting.alone_max_ms:10.2f}"
    )
    label = f"beside batches of {config.batch_rows:,} frames"
    print(
        f"  {label:<42} {waiting.beside_ms:10.2f} {waiting.beside_p99_ms:10.2f} {waiting.beside_max_ms:10.2f}"
    )
    print(f"  longest delay by the batches               {waiting.beside_max_ms - waiting.alone_ms:10.2f}")
    print(f"  ({waiting.queries} queries; {waiting.rows_per_s:,.0f} frames of batches a second)")
    return 0


def _check_numbers(config: BenchmarkServerConfig, most_waiting: int, most_rows: int) -> None:
    """ValueError for what nothing can be measured with."""
    if not 1 <= config.window <= most_waiting:
        raise ValueError(
            f"--window={config.window}: expected 1 to {most_waiting}, as many as the server lets wait"
        )
    if not 1 <= config.batch_rows <= most_rows:
        raise ValueError(f"--batch_rows={config.batch_rows}: expected 1 to {most_rows}, as many as it takes")
    if not 1 <= config.clients <= _MOST_CLIENTS:
        raise ValueError(f"--clients={config.clients}: expected 1 to {_MOST_CLIENTS}")
    if config.rounds < 1:
        raise ValueError(f"--rounds={config.rounds}: expected at least 1")
    if not 0.1 <= config.seconds <= 3600:
        raise ValueError(f"--seconds={config.seconds}: expected 0.1 to 3600")


@contextmanager
def _server(config: BenchmarkServerConfig) -> Iterator[str]:
    """The real command in a process of its own; yields its address."""
    command = [sys.executable, "-m", "lerobot_mimicik.cli.main", "serve", f"--solvers={config.solver}"]
    command += [f"--policy.path={config.policy.path}"] if config.policy.path else []
    command += [f"--arm={config.arm}", f"--bind={config.bind}", "--rate=0", "--threads=1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            # A checkpoint says that it is loaded before.
            line = next((line for line in process.stdout if line.startswith("Serving on ")), None)
            if line is None:
                raise RuntimeError("The server did not start; what it said is above.")
            yield line.removeprefix("Serving on ").partition(";")[0]
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
