"""What a deployment's recording in rerun holds."""

import re

import numpy as np
import pytest

from robot_adapters.adapter import MimicIKAdapter
from robot_adapters.arm import ArmMode, ArmState, CommandResult, CommandStatus


def test_a_recording_has_the_arms_shapes_its_motion_and_a_layout(tmp_path):
    rerun = pytest.importorskip("rerun", reason="needs the extra scripts")
    from robot_adapters.display import RerunDisplay

    adapter = MimicIKAdapter.for_arm("airbot_play")
    q = np.array(adapter.description.home)
    file = tmp_path / "arm.rrd"
    display = RerunDisplay(adapter, 20.0, str(file))
    state = ArmState(q, 0 * q, 0 * q, None, {}, 0.0, next(iter(ArmMode)))
    result = CommandResult(next(iter(CommandStatus)), q, ())
    display.frame(0, adapter.forward(q), state, q, result)
    rerun.disconnect()

    reader = pytest.importorskip("rerun.experimental").RrdReader(file)
    assert len(reader.blueprints()) == 1
    columns = str(reader.store(store=reader.recordings()[0]).schema())
    for body in range(len(q) + 1):
        assert f"/world/arm/body{body}:Transform3D" in columns
        assert re.search(rf"/world/arm/body{body}/shape\d+:Mesh3D:vertex_positions", columns)
