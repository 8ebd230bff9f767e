"""Kept for users: the errors of `lerobot_mimicik.wire.protocol` under the name that it was first published as."""

from lerobot_mimicik.wire.protocol import (
    BadRequestError,
    RateExceededError,
    ServerTimeoutError,
    ServingError,
    SolverFailedError,
    UnknownSessionError,
)

__all__ = [
    "BadRequestError",
    "RateExceededError",
    "ServerTimeoutError",
    "ServingError",
    "SolverFailedError",
    "UnknownSessionError",
]
