"""Calibration offsets: found from postures held and from positions, shown, kept, and refused where they are not known."""

import json

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
    ],
)
def test_errors_name_the_thing(tmp_path, capsys, options, reason):
    words = ["calibrate", *robot(tmp_path), *options]
    if options == ["--robot.type="]:
        words = ["calibrate"]
    assert main(words) == 1
    assert reason in capsys.readouterr().err
