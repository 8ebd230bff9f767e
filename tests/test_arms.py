"""Arm descriptions: shipped arms are complete and do not touch themselves, others are refused by name."""

from __future__ import annotations

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, ArmDescription, describe_arm
from lerobot_mimicik.kinematics.urdf import UrdfError

AIRBOT_JOINTS = ("joint1", "joint2", "joint3", "joint4", "joint5", "joint6")


def colliding_links(urdf: str, joint_names, configurations: np.ndarray) -> set[tuple[str, str]]:
    """Pairs of links, neighbours excepted, whose shapes touch in any of the configurations (n, dof)."""
    text = urdf.replace("<link", '<mujoco><compiler fusestatic="false"/></mujoco><link', 1)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    addresses = [model.joint(name).qposadr[0] for name in joint_names]
    found = set()
    for q in configurations:
        data.qpos[addresses] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact:
            a, b = (int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2))
            if model.body_parentid[a] != b and model.body_parentid[b] != a:
                found.add((model.body(a).name, model.body(b).name))
    return found


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_a_shipped_arm_has_limits_speeds_and_a_home_well_inside_them(name):
    arm = describe_arm(name)
    joints = arm.joints()
    assert len(joints) == len(arm.home) >= 5
    for joint, value in zip(joints, arm.home, strict=True):
        assert np.isfinite([joint.lower, joint.upper, joint.velocity]).all()
        assert joint.lower + 0.25 < value < joint.upper - 0.25


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_a_shipped_arm_does_not_touch_itself_around_home(name):
    arm = describe_arm(name)
    around = np.array(arm.home) + np.random.default_rng(0).uniform(-0.2, 0.2, (100, len(arm.home)))
    assert colliding_links(arm.urdf, arm.joint_names, np.vstack((arm.home, around))) == set()


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_a_shipped_arm_touches_itself_somewhere_in_its_range(name):
    arm = describe_arm(name)
    lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.joints()]).T
    anywhere = np.random.default_rng(0).uniform(lower, upper, (2000, len(lower)))
    assert colliding_links(arm.urdf, arm.joint_names, anywhere)


@pytest.mark.parametrize("log", ["rollout", "excitation_a", "excitation_b"])
def test_the_airbot_shapes_allow_what_a_real_arm_did(log, shared_data):
    import pandas as pd

    table = pd.read_parquet(shared_data(f"airbot_play_real/{log}.parquet"))
    arm = describe_arm("airbot_play")
    configurations = table[[f"q{i}" for i in range(1, 7)]].to_numpy(float)[::10]
    assert colliding_links(arm.urdf, arm.joint_names, configurations) == set()


def test_the_piper_limits_contain_what_a_real_arm_did(shared_data):
    import pandas as pd

    table = pd.read_parquet(shared_data("piper_teleop/data/chunk-000/file-000.parquet"))
    q = np.radians(np.stack(table["observation.state"].to_numpy())[:, :6])
    arm = describe_arm("piper")
    # Encoders report up to half a degree beyond the stop.
    for joint, values in zip(arm.joints(), q.T, strict=True):
        assert joint.lower - 0.01 < values.min()
        assert values.max() < joint.upper + 0.01
    assert colliding_links(arm.urdf, arm.joint_names, q[::10]) == set()


def test_a_description_survives_json():
    arm = describe_arm("airbot_play", joint_names=AIRBOT_JOINTS[::-1], tool_offset=[0.1594, 0, 0])
    assert ArmDescription.from_json(arm.to_json()) == arm
    assert arm.home == describe_arm("airbot_play").home[::-1]


def test_text_path_and_name_describe_the_same_chain(tmp_path):
    shipped = describe_arm("airbot_play")
    path = tmp_path / "mine.urdf"
    path.write_text(shipped.urdf)
    for other in (describe_arm(path), describe_arm(str(path)), describe_arm(shipped.urdf)):
        assert (other.base_link, other.tip_link, other.joint_names) == (
            "base_link",
            "end_link",
            AIRBOT_JOINTS,
        )
        assert other.urdf == shipped.urdf
        assert other.home == ()
        assert other.joints() == shipped.joints()


def test_another_tip_makes_a_shorter_arm_without_a_home():
    arm = describe_arm("airbot_play", tip_link="link3")
    assert arm.joint_names == AIRBOT_JOINTS[:3]
    assert arm.home == ()


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (
            lambda: describe_arm("ur5"),
            "'ur5' is neither a shipped arm .airbot_play, piper, so101, .*ur5e, .* nor a URDF file",
        ),
        (lambda: describe_arm("piper", tip_link="hand"), "tip link 'hand'.*link6"),
        (
            lambda: describe_arm("piper", joint_names=["joint1", "waist"]),
            "unknown waist, missing joint2, joint3",
        ),
        (lambda: describe_arm("piper", joint_names=[*AIRBOT_JOINTS, "joint1"]), "some repeated"),
        (
            lambda: ArmDescription(describe_arm("piper").urdf, "base_link", "link6", ("joint1",)).chain(),
            "missing joint2",
        ),
    ],
)
def test_what_does_not_exist_is_named_with_what_exists(call, expected):
    with pytest.raises(UrdfError, match=expected):
        call()


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda: describe_arm("piper", tool_offset=(0.1, 0.2)), "tool_offset .* has 2 numbers"),
        (
            lambda: ArmDescription("<robot/>", "a", "b", ("j",), home=(0.0, 1.0)),
            "home has 2 values for 1 joints",
        ),
        (
            lambda: ArmDescription.from_json('{"urdf": "<robot/>", "tcp": 1}'),
            "unknown entries tcp and missing",
        ),
        (lambda: ArmDescription.from_json("[]"), "JSON object"),
    ],
)
def test_values_that_do_not_fit_are_refused(call, expected):
    with pytest.raises(ValueError, match=expected):
        call()


def test_describing_an_arm_needs_neither_torch_nor_the_chain_library():
    code = (
        "import sys; from lerobot_mimicik.kinematics.arms import describe_arm; describe_arm('piper');"
        "assert not {'torch', 'pytorch_kinematics'} & set(sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
