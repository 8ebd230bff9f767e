"""Kept for users: `lerobot_mimicik.solvers.remote_client` under the name that it was first published as."""

from lerobot_mimicik.solvers.remote_client import IKClient

__all__ = ["IKClient"]
