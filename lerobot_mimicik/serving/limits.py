"""How much of a server one client may use."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Limits:
    """The limits of a server.

    Attributes:
        max_bytes: Longest request. Up to twice as long it is refused with a reply; beyond that the
            connection is closed.
        max_rows: Most rows of a batch, or frames of a recording, in one request.
        max_sessions: Most sessions of all clients together.
        rate: Requests a second that one client may send in the long run; 0 sets no limit.
        burst: Requests that it may send at once after a pause.
        max_waiting: Requests of one client that may wait for their turn.
    """

    max_bytes: int = 1 << 20
    max_rows: int = 4096
    max_sessions: int = 64
    rate: float = 20_000.0
    burst: float = 20_000.0
    max_waiting: int = 16

    def __post_init__(self) -> None:
        for entry in fields(self):
            value, least = getattr(self, entry.name), 0 if entry.name == "rate" else 1
            if not value >= least:
                raise ValueError(f"{entry.name} must be at least {least}, got {value}.")


class RateLimiter:
    """A token bucket for every client: `burst` tokens when full, refilled at `rate` a second."""

    def __init__(self, rate: float, burst: float, max_clients: int = 1024) -> None:
        """`max_clients` bounds the memory: beyond it the client known longest starts with a full bucket."""
        self.rate, self.burst, self.max_clients = rate, burst, max_clients
        self._buckets: dict[bytes | str, list[float]] = {}

    def allows(self, client: bytes | str, now: float) -> bool:
        """Take one token of `client` at time `now` (s, never decreasing); False where it has none."""
        if not self.rate:
            return True
        bucket = self._buckets.get(client)
        if bucket is None:
            if len(self._buckets) >= self.max_clients:
                del self._buckets[next(iter(self._buckets))]
            bucket = self._buckets[client] = [self.burst, now]
        tokens = min(self.burst, bucket[0] + (now - bucket[1]) * self.rate)
        allowed = tokens >= 1.0
        bucket[0], bucket[1] = tokens - 1.0 if allowed else tokens, now
        return allowed
