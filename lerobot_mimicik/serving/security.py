"""Kept for users: the keys of `lerobot_mimicik.wire.security` under the name that it was first published as."""

from lerobot_mimicik.wire.security import ClientKeys, ServerKeys, is_local, make_keys

__all__ = ["ClientKeys", "ServerKeys", "is_local", "make_keys"]
