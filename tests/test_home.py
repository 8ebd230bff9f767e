"""A home for any arm, and synthetic teleoperation that begins there."""

from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from lerobot_mimicik.cli import make_dataset
from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.home import find_home, with_home
from lerobot_mimicik.data.writer import read_arm_json
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain

# Joints as type, axis, offset from the one before [m], limits.
FIVE = (
    ("revolute", "0 0 1", "0 0 0.06", -1.9, 1.9),
    ("revolute", "0 1 0", "0.03 0 0.05", -1.7, 1.7),
    ("revolute", "0 1 0", "0.03 0 0.11", -1.7, 1.7),
    ("revolute", "0 1 0", "0.13 0 0", -1.6, 1.6),
    ("revolute", "1 0 0", "0.06 0 0", -2.7, 2.7),
)
SIX = (
    ("revolute", "0 0 1", "0 0 0.16", -6.28, 6.28),
    ("revolute", "0 1 0", "0 0.13 0", -6.28, 6.28),
    ("revolute", "0 1 0", "0.43 -0.12 0", -3.14, 3.14),
    ("revolute", "0 1 0", "0.39 0 0", -6.28, 6.28),
    ("revolute", "0 0 1", "0 0.1 0", -6.28, 6.28),
    ("revolute", "0 1 0", "0 0 -0.1", -6.28, 6.28),
)
RAIL = (("prismatic", "0 1 0", "0 0 0", -0.3, 0.3), *SIX)
SLIDE = (*FIVE[:2], ("prismatic", "1 0 0", "0.1 0 0.1", 0.0, 0.25), *FIVE[3:])


def urdf(joints) -> str:
    links = "".join(f'<link name="l{i}"/>' for i in range(len(joints) + 2))
    chain = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="1" velocity="3"/></joint>'
        for i, (kind, axis, xyz, low, high) in enumerate(joints)
    )
    last = len(joints)
    tool = (
        f'<joint name="tool" type="fixed"><parent link="l{last}"/><child link="l{last + 1}"/>'
        '<origin xyz="0.1 0 0"/></joint>'
    )
    return f'<robot name="arm">{links}{chain}{tool}</robot>'


def vega():
    folder = resources.files("dexmate_urdf") / "robots" / "humanoid" / "vega_1u"
    return describe_arm((folder / "vega_1u.urdf").read_text(), "arm_center", "L_ee")


ARMS = {
    "five": lambda: describe_arm(urdf(FIVE)),
    "six": lambda: describe_arm(urdf(SIX)),
    "rail": lambda: describe_arm(urdf(RAIL)),
    "slide": lambda: describe_arm(urdf(SLIDE)),
    "vega": vega,
}


@pytest.mark.parametrize("name", ARMS)
def test_a_home_is_found_far_from_limits_and_singularities_and_the_same_every_time(name):
    arm = ARMS[name]()
    home = find_home(arm)
    np.testing.assert_array_equal(home, find_home(arm))
    joints = arm.joints()
    for value, joint in zip(home, joints, strict=True):
        assert min(value - joint.lower, joint.upper - value) > 0.1 * (joint.upper - joint.lower)
    spread = np.random.default_rng(1).uniform(
        [max(j.lower, -np.pi) for j in joints], [min(j.upper, np.pi) for j in joints], (200, len(joints))
    )
    jacobians = array_chain(arm).forward_and_jacobian(np.vstack([home, spread]))[2]
    manipulability = np.linalg.svd(jacobians, compute_uv=False).min(axis=1)
    assert manipulability[0] > np.median(manipulability)
    assert ArmArrays(with_home(arm)).free(home[None])[0]


@pytest.mark.parametrize("name", ["five", "slide"])
def test_teleoperation_is_made_for_a_urdf_that_names_no_home(tmp_path, capsys, name):
    (tmp_path / "arm.urdf").write_text(urdf({"five": FIVE, "slide": SLIDE}[name]))
    options = ["--episodes=2", "--ood=false", "--workers=1", f"--robot={tmp_path / 'arm.urdf'}"]
    assert make_dataset.main(["--source=synthetic", f"--output={tmp_path / 'out'}", *options]) == 0
    home = read_arm_json(tmp_path / "out" / "train").home
    assert ",".join(map(str, home)) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("home", "message"),
    [
        ("0,0,0", "home has 3 values for 5 joints"),
        ("0,0,9,0,0", "j2 is 9, outside"),
        ("a", "--robot.home takes"),
    ],
)
def test_a_home_that_is_none_is_refused(tmp_path, capsys, home, message):
    (tmp_path / "arm.urdf").write_text(urdf(FIVE))
    options = ["--source=synthetic", f"--output={tmp_path / 'out'}", "--episodes=2", f"--robot.home={home}"]
    assert make_dataset.main([*options, f"--robot.name={tmp_path / 'arm.urdf'}"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_home_that_is_given_is_taken():
    arm = ARMS["five"]()
    assert with_home(arm, (0.1, 0.2, 0.3, 0.4, 0.5)).home == (0.1, 0.2, 0.3, 0.4, 0.5)
    named = describe_arm("airbot_play")
    assert with_home(named) == named
    assert len(with_home(replace(named, home=())).home) == 6
