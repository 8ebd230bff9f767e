"""`mimicik serve`: answers for solvers over ZeroMQ, so that a robot or a benchmark elsewhere may ask them."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from lerobot_mimicik.checkpoints import LEARNED
from lerobot_mimicik.cli.eval import PolicySource
from lerobot_mimicik.cli.options import parse, say_loading, words
from lerobot_mimicik.kinematics.names import did_you_mean

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm
    from lerobot_mimicik.serving.server import IKServer
    from lerobot_mimicik.solvers import IKSolver

HELP = "Answer IK questions of other processes and computers, for any solver, over ZeroMQ."

_LEARNED = (*LEARNED, "mimicik_guided")  # solvers that need the checkpoint


@dataclass
class ServeConfig:
    """Options of `mimicik serve`.

    Example: `mimicik serve --policy.path=outputs/demo/train --bind=tcp://127.0.0.1:5555`
    """

    policy: PolicySource = field(default_factory=PolicySource)
    # Solvers to answer for; empty: hold, and mimicik where there is a checkpoint.
    solvers: str = ""
    # A shipped arm, or the path of a URDF; empty: the checkpoint's, else airbot_play.
    arm: str = ""
    # tcp://HOST:PORT (port 0: a free one) or ipc://PATH. Other than 127.0.0.1 needs keys.
    bind: str = "tcp://127.0.0.1:5555"
    # Where the policy runs (cpu, cuda, mps); empty: as its configuration says.
    device: str = ""
    # Threads that torch uses; 0 leaves it to torch.
    threads: int = 0
    # This server's secret key file (NAME.key_secret).
    secret_key: str = ""
    # Folder of the public keys (*.key) of the clients that may connect.
    allowed_keys: str = ""
    # Write a new key pair into this folder and end.
    make_keys: str = ""
    # Name of that key pair's files.
    key_name: str = "server"
    # Longest request, in bytes.
    max_bytes: int = 1 << 20
    # Most rows of a batch, or frames of a recording, in one request.
    max_rows: int = 4096
    # Most sessions; to open one more, that idle for longest is dropped.
    max_sessions: int = 64
    # Requests a second that one client may send in the long run, and at once; 0: any number.
    rate: float = 20_000.0


def main(argv: Sequence[str]) -> int:
    """Run the command."""
    config = parse(ServeConfig, argv, "mimicik serve")
    try:
        from lerobot_mimicik.wire.security import make_keys
    except ModuleNotFoundError as error:
        raise RuntimeError(
            f"{error.name} is not installed: pip install 'lerobot_policy_mimicik[serve]'."
        ) from error

    if config.make_keys:
        public, secret = make_keys(config.make_keys, config.key_name)
        print(f"{public} may be given to anybody; {secret} stays here.")
        return 0
    check_paths(config)
    with make_server(config) as server:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: server.stop())
        print(f"Serving on {server.address}; Ctrl-C stops.", flush=True)
        server.serve()
        print(f"Stopped: {server.answered} requests answered, {server.refused} refused.", flush=True)
    return 0


def check_paths(config: ServeConfig) -> None:
    """Say what does not exist before seconds go into imports."""
    from lerobot_mimicik.checkpoints import check_device, find_checkpoint
    from lerobot_mimicik.inputs import check_exists
    from lerobot_mimicik.kinematics.arms import describe_arm

    if config.policy.path:
        find_checkpoint(config.policy.path)
    if config.arm:
        describe_arm(config.arm)
    if config.device:
        check_device(config.device)
    for option in ("secret_key", "allowed_keys"):
        if getattr(config, option):
            check_exists(getattr(config, option), f"--{option}")


def make_server(config: ServeConfig) -> IKServer:
    """Load what the options name and begin to listen.

    Raises:
        ValueError: If an option does not fit; the message names it and what exists.
        OSError: If a file is missing or the address cannot be had.
    """
    say_loading()
    import torch

    from lerobot_mimicik.serving.limits import Limits
    from lerobot_mimicik.serving.server import IKServer
    from lerobot_mimicik.wire.security import ServerKeys

    if bool(config.secret_key) != bool(config.allowed_keys):
        raise ValueError("--secret_key and --allowed_keys belong together; --make_keys=DIR makes a key pair.")
    if config.threads:
        torch.set_num_threads(config.threads)
    arm, factories = solvers_of(config)
    limits = Limits(
        config.max_bytes, config.max_rows, config.max_sessions, config.rate, max(config.rate, 1.0)
    )
    keys = ServerKeys(config.secret_key, config.allowed_keys) if config.secret_key else None
    return IKServer(factories, arm.joint_names, config.bind, limits, keys)


def solvers_of(config: ServeConfig) -> tuple[SerialArm, dict[str, Callable[[], IKSolver]]]:
    """The arm and what makes each of its solvers. ValueError for an option that does not fit."""
    import torch

    from lerobot_mimicik.checkpoints import FORESIGHT_SOLVERS, find_checkpoint, load_policy
    from lerobot_mimicik.foresight.weights import is_foresight, load_weights
    from lerobot_mimicik.kinematics.arms import describe_arm
    from lerobot_mimicik.kinematics.chain import SerialArm
    from lerobot_mimicik.kinematics.plausibility import why_not_same_arm
    from lerobot_mimicik.solvers import known_solvers, make_solver

    known = [name for name in known_solvers() if name != "remote"]
    names = words(config.solvers) or (["hold", "mimicik"] if config.policy.path else ["hold"])
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(
            f"--solvers: unknown {', '.join(unknown)}; known are {', '.join(known)}."
            + did_you_mean(unknown[0], known)
        )
    learned = [name for name in names if name in _LEARNED]
    if learned and not config.policy.path:
        raise ValueError(f"--solvers names {learned[0]}, but --policy.path is missing: which checkpoint?")
    options: dict[str, dict[str, object]] = {}
    description = describe_arm(config.arm or "airbot_play")
    if config.policy.path and is_foresight(found := find_checkpoint(config.policy.path)):
        # Without a checkpoint of its own it has the package's weights.
        options = {name: {"policy": found} for name in FORESIGHT_SOLVERS}
        description = description if config.arm else load_weights(found).description
    if learned:
        policy = load_policy(config.policy.path, config.device or None)
        options |= {name: {"policy": policy} for name in learned}
        own = policy.config.arm_description()
        reason = why_not_same_arm(description, own) if config.arm else None
        if reason is not None:
            raise ValueError(f"--arm={config.arm} is another arm than the policy's: {reason}.")
        description = description if config.arm else own
    arm = SerialArm(description, dtype=torch.float64)
    return arm, {name: partial(make_solver, name, arm, **options.get(name, {})) for name in names}
