"""What runs beside an arm, and every command until it works, needs neither torch nor LeRobot."""

import subprocess
import sys

import pytest

_HEAVY = "[m for m in ('torch', 'lerobot', 'pytorch_kinematics', 'matplotlib', 'pandas') if m in sys.modules]"


@pytest.mark.parametrize(
    "script",
    [
        """
import numpy as np
import robot_adapters.simulation.cell, robot_adapters.airbot.arm, robot_adapters.deployment
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.solvers import known_solvers, make_solver
from robot_adapters.adapter import MimicIKAdapter
assert "mimicik" in known_solvers()
adapter = MimicIKAdapter.for_arm("airbot_play")
q = np.array(adapter.description.home)
target = adapter.forward(q + 0.01)
assert adapter.solve(q, target).status == "reached"
assert np.allclose(array_chain(adapter.description).pose(q[None])[0], adapter.forward(q))
solver = make_solver("guided", adapter)
solver.reset(q)
assert np.allclose(adapter.forward(solver.solve(q, target)), target, atol=1e-3)
""",
        """
import contextlib, io
from lerobot_mimicik.cli.main import main, subcommands
for name in subcommands():
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main([name, "--help"])
""",
    ],
    ids=["adapter", "commands"],
)
def test_no_torch_and_no_lerobot(script):
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{script}\nprint({_HEAVY})"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
