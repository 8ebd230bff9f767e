"""Recordings of made-up hand motion for the tests of retargeting."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.retargeting.recordings import Recording


def hand_motion(
    seed: int, seconds: float = 2.0, rate: float = 20.0, size: float = 0.25
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) [s] and poses (n, 7) of a smooth reach of about `size` metres with some turning."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate
    waves = [
        rng.normal(size=6) * np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 6, 6)) for f in (0.3, 0.7)
    ]
    motion = sum(waves)
    rotation = Rotation.from_rotvec(0.3 * motion[:, 3:]) * Rotation.random(rng=np.random.default_rng(seed))
    return t, np.concatenate([0.4 * size * motion[:, :3] + (1.0, 2.0, 1.2), rotation.as_quat()], axis=1)


def hand_recording(seed: int, **options: float) -> Recording:
    """One recording of `hand_motion`."""
    t, pose = hand_motion(seed, **options)
    return Recording(f"episode={seed}", f"session={seed % 3}", t, pose)


def hand_table(count: int, **options: float) -> pd.DataFrame:
    """A table of `count` recordings with columns session, episode, t, x .. z, qx .. qw."""
    tables = []
    for episode in range(count):
        t, pose = hand_motion(episode, **options)
        table = pd.DataFrame(pose, columns=["x", "y", "z", "qx", "qy", "qz", "qw"])
        table.insert(0, "session", f"s{episode % 3}")
        table.insert(1, "episode", episode)
        table.insert(2, "t", t)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)
