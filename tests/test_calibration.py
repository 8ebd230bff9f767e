"""Calibration offsets: found from postures held and from positions, shown, kept, and refused where they are not known."""

import io
import json
import re

import numpy as np
import pytest

from lerobot_mimicik.cli.main import main
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.point_chain import point_chain
from robot_adapters.calibration import Observation, fit_offsets
from robot_adapters.robots.joint_offsets import read_offsets

ARM = describe_arm("so101")
HOME = np.array(ARM.home)
OFFSETS = np.radians([3.0, -5.0, 2.0, 4.0, -1.0])
NAMES = list(ARM.joint_names)


def test_a_held_posture_gives_the_offsets_and_what_is_left():
    random = np.random.default_rng(0)
    noise = 0.002 * random.standard_normal((4, 5))
    observations = [Observation(HOME - OFFSETS + each, held=HOME) for each in noise]
    fit = fit_offsets(ARM, observations)
    np.testing.assert_allclose(fit.offsets, OFFSETS, atol=0.004)
    assert fit.determined.all()
    assert 1e-4 < fit.joints_left.max() < 0.005
    assert np.isnan(fit.after)


def test_measured_positions_give_the_offsets_of_the_joints_that_move_the_tool():
    chain, random = point_chain(ARM), np.random.default_rng(1)
    true = HOME + random.uniform(-0.6, 0.6, (12, 5))
    observations = [Observation(q - OFFSETS, position=chain.pose(q)[:3]) for q in true]
    fit = fit_offsets(ARM, observations)
    assert fit.before > 0.01
    assert fit.after < 1e-4
    np.testing.assert_allclose(fit.offsets[:4], OFFSETS[:4], atol=1e-3)
    alone = fit_offsets(ARM, observations[:1])  # one point leaves joints open
    assert not alone.determined.all()


def test_nonsense_is_refused():
    for observations, reason in (
        ([], "no observations"),
        ([Observation(HOME)], "neither"),
        ([Observation(HOME[:2], held=HOME)], "joints .* expected 5"),
    ):
        with pytest.raises(ValueError, match=reason):
            fit_offsets(ARM, observations)


def robot(tmp_path, **options):
    inner = {"type": "mimicik_sim", "id": "mine", "arm": "so101", "noise": 0.0, "sag": 1e-4}
    inner |= {"calibration_dir": tmp_path, "start": str((HOME - OFFSETS).tolist())}
    return [f"--robot.{key}={value}" for key, value in (inner | options).items()]


def test_the_command_keeps_what_a_held_arm_shows(tmp_path, monkeypatch, capsys):
    prompts = []
    monkeypatch.setattr("builtins.input", prompts.append)
    assert main(["calibrate", *robot(tmp_path)]) == 0
    assert "Bring the arm to home (shoulder_pan 0.0, " in prompts[-1]
    assert "-5.00 deg" in capsys.readouterr().out
    np.testing.assert_allclose(read_offsets(tmp_path / "mine.offsets.json", NAMES), OFFSETS, atol=1e-3)
    # Measured anew, with the old offsets in place, it finds the same.
    assert main(["calibrate", *robot(tmp_path)]) == 0
    np.testing.assert_allclose(read_offsets(tmp_path / "mine.offsets.json", NAMES), OFFSETS, atol=1e-3)


def test_the_command_keeps_nothing_that_is_not_known(tmp_path, capsys):
    chain, recording = point_chain(ARM), tmp_path / "poses.json"
    joints = {f"{name}.pos": value for name, value in zip(NAMES, np.degrees(HOME - OFFSETS), strict=True)}
    recording.write_text(json.dumps([{"joints": joints, "position": chain.pose(HOME)[:3].tolist()}]))
    assert main(["calibrate", *robot(tmp_path), f"--recording={recording}"]) == 1
    assert "not known" in capsys.readouterr().out
    held = dict(zip(NAMES, np.degrees(HOME).tolist(), strict=True))
    recording.write_text(json.dumps([{"joints": joints, "held": held}]))
    assert main(["calibrate", *robot(tmp_path), f"--recording={recording}", "--dry_run=true"]) == 0
    assert not (tmp_path / "mine.offsets.json").exists()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--robot.type="], "which robot"),
        (["--side=left"], "it has one arm"),
        (["--postures=[bent]"], "home, rest, zero"),
        (["--recording=nowhere.json"], "nowhere.json"),
        ([], "nobody can press Enter"),
    ],
)
def test_errors_name_the_thing(tmp_path, monkeypatch, capsys, options, reason):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    words = ["calibrate", *robot(tmp_path), *options]
    if options == ["--robot.type="]:
        words = ["calibrate"]
    assert main(words) == 1
    assert reason in capsys.readouterr().err


HELD = dict.fromkeys(NAMES, 0.0)
JOINTS = {f"{name}.pos": 1.0 for name in NAMES}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "poses.json is no JSON file"),
        ("[" * 100_000, "poses.json is no JSON file"),
        (json.dumps([{"joints": {}, "held": HELD}]), "poses.json, entry 0: .*shoulder_pan.pos"),
        # Offsets of more than half a turn are another unit or another arm's postures.
        (
            json.dumps([{"joints": JOINTS | {"elbow_flex.pos": 1e6}, "held": HELD}]),
            "are the robot's joints in another unit",
        ),
    ],
)
def test_recordings_that_cannot_be_are_refused_and_nothing_is_kept(tmp_path, capsys, text, reason):
    (tmp_path / "poses.json").write_text(text)
    assert main(["calibrate", *robot(tmp_path), f"--recording={tmp_path / 'poses.json'}"]) == 1
    assert re.search(reason, capsys.readouterr().err)
    assert not (tmp_path / "mine.offsets.json").exists()


def test_damaged_offsets_are_measured_anew_and_a_file_of_somebody_else_is_kept(tmp_path, capsys):
    offsets, recording = tmp_path / "mine.offsets.json", tmp_path / "poses.json"
    recording.write_text(json.dumps([{"joints": JOINTS, "held": HELD}]))
    offsets.write_text("my thesis")
    assert main(["calibrate", *robot(tmp_path), f"--recording={recording}"]) == 1
    assert "is not replaced" in capsys.readouterr().err
    assert offsets.read_text() == "my thesis"
    offsets.write_text('{"offsets_rad": {"elbow_flex": 17453.0}}')
    assert main(["calibrate", *robot(tmp_path), f"--recording={recording}"]) == 0
    np.testing.assert_allclose(read_offsets(offsets, NAMES), np.radians(-1.0))
