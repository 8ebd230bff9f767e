"""Joint keys as other plugins and their datasets spell them: `joint_1.pos` is `joint1.pos`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from lerobot_mimicik.columns import canonical_name


def own_keys(action: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """An action under a robot's own keys where it has them with other separators; the rest stays as it is."""
    own = {canonical_name(key): key for key in keys}
    return {own.get(canonical_name(key), key): value for key, value in action.items()}
