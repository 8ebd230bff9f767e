"""A solver of an IK server (`mimicik serve`), by its address."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lerobot_mimicik.solvers.base import register_solver

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.chain import SerialArm
    from lerobot_mimicik.solvers.remote_client import IKClient


@register_solver("remote")
def remote_solver(
    arm: SerialArm,
    address: str = "tcp://127.0.0.1:5555",
    solver: str = "mimicik",
    timeout_s: float = 1.0,
    secret_key: str = "",
    server_key: str = "",
    name: str = "",
) -> IKClient:
    """A client of the server at `address`, for an arm with the server's joints.

    Args:
        arm: The arm that is driven here.
        address: `tcp://HOST:PORT` or `ipc://PATH`.
        solver: Which of the server's solvers.
        timeout_s: Longest wait for an answer, in s.
        secret_key: Path of the own secret key, where the server has keys.
        server_key: Path of the server's public key, then needed too.
        name: How tables call it.

    Raises:
        ValueError: If only one key is given; otherwise as `IKClient`.
        ModuleNotFoundError: If ZeroMQ or msgpack is not installed.
    """
    try:
        from lerobot_mimicik.solvers.remote_client import IKClient
        from lerobot_mimicik.wire.security import ClientKeys
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"The solver 'remote' needs {error.name}: pip install 'lerobot_policy_mimicik[serve]'."
        ) from error

    if bool(secret_key) != bool(server_key):
        raise ValueError(
            "secret_key and server_key belong together: the own secret and the server's public key."
        )
    keys = ClientKeys(secret_key, server_key) if secret_key else None
    return IKClient(address, solver, arm.joint_names, timeout_s, keys, name)
