"""`mimicik bench-speed`: every row is asked alike, and the numbers say under which circumstances they were taken."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_mimicik.cli.main import main
from lerobot_mimicik.evaluation.speed import WARM_UP, Machine, Row, measure, table
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from lerobot_mimicik.kinematics.plausibility import joint_limits
from robot_adapters.cli.bench_speed import motion


def test_all_rows_are_asked_the_same_questions_as_often():
    seen: dict[str, list[int]] = {"one": [], "other": []}
    rows, machine = measure({name: asked.append for name, asked in seen.items()}, frames=7, queries=120)
    assert (
        seen["one"]
        == seen["other"]
        == [*[i % 7 for i in range(WARM_UP)], *[(WARM_UP + i) % 7 for i in range(120)]]
    )
    assert [row.name for row in rows] == ["one", "other"]
    assert all(len(row.milliseconds) == len(row.processor_ms) == 120 for row in rows)
    assert machine.ran > 0
    with pytest.raises(ValueError, match="queries=0"):
        measure({}, 7, 0)


def test_the_table_has_ratios_and_says_where_no_energy_is_counted():
    rows = [
        Row("eager", np.array([4.0, 4.0, 8.0]), np.array([4.0, 4.0, 4.0]), None),
        Row("onnx", np.array([1.0, 1.0, 1.0]), np.array([0.5, 0.5, 0.5]), 12.0),
    ]
    head, _, eager, onnx = table(rows, "eager").splitlines()
    assert "times faster than eager" in head
    assert eager == "| eager | 4.000 | 7.600 | 7.920 | 1.98 | 4.000 | 1.0 | not counted |"
    assert onnx == "| onnx | 1.000 | 1.000 | 1.000 | 1.00 | 0.500 | 4.0 | 12.00 |"
    lines = table(rows).splitlines()
    assert {line.count("|") for line in lines} == {8}


def test_a_busy_machine_is_named():
    assert Machine(load=0.0, ran=1.0, grown_mb=0.0).busy == ""
    assert "ran 40 % of the time" in Machine(load=0.0, ran=0.4, grown_mb=0.0).busy
    assert "load 90.0" in Machine(load=90.0, ran=1.0, grown_mb=0.0).busy


@pytest.mark.parametrize("arm", SHIPPED_ARMS)
def test_the_motion_stays_within_the_limits(arm):
    description = describe_arm(arm)
    lower, upper = joint_limits(description)
    q, targets = motion(description)
    assert ((q >= lower) & (q <= upper)).all()
    assert np.abs(np.diff(q, axis=0)).max() < 0.05
    assert targets.shape == (len(q), 7)


def test_the_command_measures_engines_and_adapter(capsys):
    arguments = ["--sizes=small", "--engines=traced", "--queries=2", "--batch_seconds=0.01"]
    assert main(["bench-speed", *arguments]) == 0
    said = capsys.readouterr().out
    for row in (
        "small, eager",
        "small, traced",
        "adapter: guided",
        "adapter: guided with foresight, 8 ahead",
    ):
        assert f"| {row} |" in said
    assert "solves a second in batches of 4,096 on 1 threads" in said
    assert "float32" in said
