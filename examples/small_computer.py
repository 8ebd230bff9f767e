"""The adapter on a small computer: guided solver and an exported network, without torch and LeRobot.

On the computer where the policy was trained: `mimicik export --policy.path=RUN --output=arm.onnx`, and `uv build --wheel`.
On the small one, with the wheel, the file and what lies beside this script:

    python3 -m venv small
    small/bin/pip install --no-deps lerobot_policy_mimicik-*.whl
    small/bin/pip install -r small_computer.txt
    small/bin/python small_computer.py arm.onnx

Without a file, or with an arm's name, the weights in the package answer (`airbot_play`).
"""

from __future__ import annotations

import statistics
import sys
import time

import numpy as np

from robot_adapters.adapter import IKStatus, MimicIKAdapter

_FRAMES = 100  # of the circle, at 20 Hz
_RADIUS = 0.03  # m
_HEAVY = ("torch", "lerobot")


def main(weights: str = "airbot_play", frames: int = _FRAMES) -> list[IKStatus]:
    """Follow a circle with eight targets known ahead; what became of the targets."""
    adapter = MimicIKAdapter.from_pretrained(weights)
    q = np.array(adapter.description.home or (adapter.lower + adapter.upper) / 2)
    angle = 2 * np.pi * np.arange(frames) / _FRAMES
    targets = np.repeat(adapter.forward(q)[None], frames, axis=0)
    targets[:, 1] += _RADIUS * np.sin(angle)
    targets[:, 2] += _RADIUS * (1.0 - np.cos(angle))
    found, seconds = [], []
    for t, target in enumerate(targets):
        begin = time.perf_counter()
        result = adapter.solve(q, target, targets[t + 1 : t + 9])
        seconds.append(time.perf_counter() - begin)
        q = result.q  # a real arm's measured joints go here
        found.append(result.status)
    print(f"{weights}: {found.count(IKStatus.REACHED)} of {frames} targets reached")
    print(f"{1e3 * statistics.median(seconds):.2f} ms a command, median")
    return found


if __name__ == "__main__":
    main(*sys.argv[1:2])
    loaded = [name for name in _HEAVY if name in sys.modules]
    print(f"loaded: {', '.join(loaded) if loaded else 'neither torch nor LeRobot'}")
