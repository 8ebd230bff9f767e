"""`mimicik make-dataset` as typed."""

import json

import pytest
from hand_recordings import hand_table

from lerobot_mimicik.cli import make_dataset


@pytest.fixture
def source(tmp_path):
    hand_table(3, seconds=1.0).rename(columns={"t": "clock"}).to_csv(tmp_path / "hands.csv", index=False)
    return tmp_path / "hands.csv"


def test_recordings_become_a_dataset(tmp_path, source, capsys):
    status = make_dataset.main(
        [
            "--source=ee",
            f"--input={source}",
            "--robot=airbot_play",
            "--robot.tool_offset=0.1594,0,0",
            f"--output={tmp_path / 'set'}",
            "--columns.time=clock",
            "--workers=0",
            "--fps=10",
            "--resume",
        ]
    )
    assert status == 0
    assert "3 recordings" in capsys.readouterr().out
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["fps"] == 10
    assert json.loads((tmp_path / "set/meta/arm.json").read_text())["tool_offset"] == [0.1594, 0, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--source=video", "--output=x"], "one of synthetic, ee, joints, stress, got 'video'"),
        (
            ["--source=stress", "--output=x", "--stress.kinds=fire"],
            "unknown stress set 'fire'; known are tremor-0mm",
        ),
        (["--source=stress", "--output=x", "--input=y"], "y is not a LeRobot dataset"),
        (["--source=ee", "--output=x"], "--input is missing"),
        (["--source=ee", "--input=x"], "--output is missing"),
        (["--source=synthetic", "--output=x"], "--episodes must be positive"),
        (["--source=synthetic", "--output=x", "--episodes=3", "--input=y"], "belong to --source=ee"),
        (
            ["--source=joints", "--output=x", "--input=y", "--episodes=2"],
            "does not belong to --source=joints",
        ),
        (["--source=ee", "--output=x", "--input=y", "--columns.joints=q1"], "belongs to --source=joints"),
        (["--source=ee", "--output=x", "--input=nothing.csv"], "nothing.csv does not exist"),
        (["--source=ee", "--output=x", "--input=y", "--robot=nobody"], "neither a shipped arm"),
        (
            ["--source=ee", "--output=x", "--input=y", "--fit.workspace=a,b,c"],
            "--fit.workspace takes numbers",
        ),
    ],
)
def test_mistakes_are_named_without_a_traceback(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "y").mkdir()
    assert make_dataset.main(arguments) == 2
    assert message in capsys.readouterr().err


def test_help_says_what_every_option_does(capsys):
    with pytest.raises(SystemExit):
        make_dataset.main(["--help=all"])
    text = capsys.readouterr().out
    for word in ("--source", "--input", "--fit.max_step", "--columns.quaternion_order", "UMI", "zarr"):
        assert word in text
