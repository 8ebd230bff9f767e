"""The guided solver drives a simulated AIRBOT Play along a circle, over a virtual CAN bus.

Run it with `uv run python examples/drive_simulated_arm.py`. For a real arm take `AirbotArm("socketcan", "can0")` and a
`RealClock` in place of the cell, after `mimicik doctor --interface=socketcan` has found nothing wrong.
"""

from __future__ import annotations

import numpy as np

from robot_adapters.adapter import MimicIKAdapter
from robot_adapters.simulation.cell import SimulatedCell

FPS, RADIUS = 20, 0.03  # Hz, m


def main(seconds: float = 4.0) -> tuple[float, float]:
    """Drive one circle; the largest error of a command, and of the measured tool (the arm lags) [m]."""
    adapter = MimicIKAdapter.for_arm("airbot_play")
    frames = round(seconds * FPS)
    phase = 2 * np.pi * np.arange(frames) / frames
    asked, measured = [], []
    # Time is simulated: a sleep returns as soon as arm, bus and driver have done what they do meanwhile.
    with SimulatedCell(q=adapter.description.home) as cell, cell.arm as arm:
        centre = adapter.forward(arm.read().q)
        for angle in phase:
            q = arm.read().q
            target = centre.copy()
            target[:3] += RADIUS * np.array([0.0, np.sin(angle), np.cos(angle) - 1.0])
            command = adapter.solve(q, target)
            sent = arm.command(command.q)
            adapter.commanded(sent.q_sent)  # what the driver's own limits made of it
            asked.append(command.position_error)
            measured.append(float(np.linalg.norm(adapter.forward(q)[:3] - target[:3])))
            for event in sent.events:
                print(event.message)
            cell.clock.sleep(1 / FPS)
    print(f"commands at most {max(asked) * 1e3:.2f} mm off, the lagging arm {max(measured) * 1e3:.1f} mm")
    return max(asked), max(measured)


if __name__ == "__main__":
    main()
