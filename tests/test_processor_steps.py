"""Processor steps: the contract of LeRobot's own IK step, and checkpoints with the inverse kinematics inside."""

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import RobotProcessorPipeline
from lerobot.processor.converters import robot_action_observation_to_transition, transition_to_robot_action

from lerobot_mimicik.foresight.weights import SHIPPED
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.poses import PoseFormat, encode_pose
from lerobot_mimicik.solvers import make_solver
from robot_adapters.adapter import IKStatus, MimicIKAdapter
from robot_adapters.processor_steps import MimicIKEEToJoints
from robot_adapters.wrapping import wrap_checkpoint

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)


@pytest.fixture(scope="module")
def adapter():
    return MimicIKAdapter(make_solver("mink", SerialArm(ARM)), ARM)


def ee_action(adapter, q, gripper=0.5):
    pose = encode_pose(adapter.forward(q), PoseFormat.ROTATION_VECTOR)
    names = [f"ee.{name}" for name in ("x", "y", "z", "wx", "wy", "wz")]
    return dict(zip(names, pose.tolist(), strict=True)) | {"ee.gripper_pos": gripper}


@pytest.mark.parametrize("units", ["rad", "deg"])
@pytest.mark.parametrize("gripper", ["gripper", "jaw", None])
def test_same_place_as_lerobots_step(adapter, units, gripper):
    adapter.reset()
    motors = [*reversed(ARM.joint_names), *([gripper] if gripper else [])]
    step = MimicIKEEToJoints(adapter, motors, joint_units=units)
    pipeline = RobotProcessorPipeline(
        steps=[step],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    one = 1.0 if units == "rad" else np.degrees(1.0)
    measured = {f"{name}.pos": float(q * one) for name, q in zip(ARM.joint_names, HOME, strict=True)}
    action = pipeline((ee_action(adapter, HOME + 0.02), measured | {"other.pos": 9.0}))
    assert set(action) - {"ee.gripper_pos"} == {f"{name}.pos" for name in motors}
    q = np.array([action[f"{name}.pos"] for name in ARM.joint_names]) / one
    np.testing.assert_allclose(adapter.forward(q)[:3], adapter.forward(HOME + 0.02)[:3], atol=1e-3)
    assert step.result.status is IKStatus.REACHED
    if gripper:
        assert action[f"{gripper}.pos"] == 0.5


def test_missing_numbers_are_named(adapter):
    step = MimicIKEEToJoints(adapter, [*ARM.joint_names, "gripper"], "rad")
    action = ee_action(adapter, HOME)
    del action["ee.wz"]
    transition = {TransitionKey.ACTION: action, TransitionKey.OBSERVATION: {}}
    with pytest.raises(KeyError, match=r"ee\.wz"):
        step(transition)
    transition = {
        TransitionKey.ACTION: ee_action(adapter, HOME),
        TransitionKey.OBSERVATION: {"joint1.pos": 0.0},
    }
    with pytest.raises(KeyError, match=r"joint2\.pos"):
        step(transition)
    with pytest.raises(ValueError, match="joint6"):
        MimicIKEEToJoints(adapter, list(ARM.joint_names[:5]), "rad")


def test_it_takes_the_keywords_of_lerobots_step(adapter):
    names = list(ARM.joint_names)
    step = MimicIKEEToJoints(
        kinematics=adapter, motor_names=names, joint_units="deg", initial_guess_current_joints=False
    )
    assert step.adapter is adapter
    assert adapter.settings.reference == "commanded"
    with pytest.raises(TypeError, match=r"got str; MimicIKAdapter\.from_pretrained"):
        MimicIKEEToJoints(kinematics="robot.urdf", motor_names=names, joint_units="deg")
    with pytest.raises(TypeError, match="got none"):
        MimicIKEEToJoints(motor_names=names, joint_units="deg")


def test_units_have_no_default_and_wrong_ones_are_named(adapter):
    with pytest.raises(ValueError, match="joint_units='': expected 'rad' or 'deg'"):
        MimicIKEEToJoints(adapter, list(ARM.joint_names))
    step = MimicIKEEToJoints(adapter, [*ARM.joint_names, "gripper"], "rad")
    degrees = {f"{name}.pos": float(np.degrees(q)) for name, q in zip(ARM.joint_names, HOME, strict=True)}
    radians = {f"{name}.pos": float(q) for name, q in zip(ARM.joint_names, HOME, strict=True)}
    action = ee_action(adapter, HOME)
    with pytest.raises(ValueError, match=r"degrees.*joint_units is 'rad'"):
        step({TransitionKey.ACTION: dict(action), TransitionKey.OBSERVATION: degrees})
    turned = action | {"ee.wx": 90.0}
    with pytest.raises(ValueError, match="rotation vector in rad"):
        step({TransitionKey.ACTION: turned, TransitionKey.OBSERVATION: radians})
    step({TransitionKey.ACTION: action | {"ee.x": 300.0, "ee.z": 200.0}, TransitionKey.OBSERVATION: radians})
    assert step.result.status is IKStatus.FAILED
    assert "millimetres" in step.result.message


def test_a_wrapped_checkpoint_takes_and_gives_joints(act_run, mimicik_run, tmp_path):
    folder = wrap_checkpoint(str(act_run), str(mimicik_run), tmp_path / "wrapped")
    assert not any(path.suffix in (".pkl", ".pt", ".bin") for path in folder.iterdir())
    config = PreTrainedConfig.from_pretrained(folder)
    pre, post = make_pre_post_processors(config, pretrained_path=str(folder))
    batch = pre({"observation.state": torch.as_tensor(HOME, dtype=torch.float32), "task": ""})
    plain, _ = make_pre_post_processors(
        config, pretrained_path=str(act_run / "checkpoints/last/pretrained_model")
    )
    adapter = MimicIKAdapter.from_pretrained(mimicik_run)
    pose = torch.as_tensor(adapter.forward(HOME), dtype=torch.float32)
    expected = plain({"observation.state": pose, "observation.environment_state": pose, "task": ""})
    for key in ("observation.state", "observation.environment_state"):
        torch.testing.assert_close(batch[key], expected[key], atol=1e-4, rtol=0)
    step = post.steps[-1]
    near = torch.as_tensor(adapter.forward(HOME + 0.01), dtype=torch.float32)[None]
    transition = step({TransitionKey.ACTION: near})
    expected = adapter.solve(HOME, near[0].double().numpy())
    np.testing.assert_allclose(transition[TransitionKey.ACTION][0].numpy(), expected.q, atol=1e-4)
    # A chunk without new observations: each pose starts from the command before it.
    again = step({TransitionKey.ACTION: near})
    assert np.abs((again[TransitionKey.ACTION] - transition[TransitionKey.ACTION]).numpy()).max() < 0.05
    post.reset()
    with pytest.raises(RuntimeError, match="no joints yet"):
        step({TransitionKey.ACTION: near})
    # Two arms of one checkpoint: neither sees the other's joints, whoever is asked first.
    arms = [(pre, post), make_pre_post_processors(config, pretrained_path=str(folder))]
    starts = (HOME, HOME + 0.4)
    for (before, after), start in zip(arms, starts, strict=True):
        after.reset()
        before({"observation.state": torch.as_tensor(start, dtype=torch.float32), "task": ""})
    for (_, after), start in reversed(list(zip(arms, starts, strict=True))):
        target = torch.as_tensor(adapter.forward(start), dtype=torch.float32)[None]
        answer = after.steps[-1]({TransitionKey.ACTION: target})[TransitionKey.ACTION][0].numpy()
        assert np.abs(answer - start).max() < 0.05
    # The first query after loading finds the network traced.
    fresh = make_pre_post_processors(config, pretrained_path=str(folder))[1].steps[-1]
    assert fresh.adapter.solver.engine
    with pytest.raises(ValueError, match="degrees"):
        pre({"observation.state": torch.as_tensor(np.degrees(HOME), dtype=torch.float32), "task": ""})
    fresh.relative_step = None
    with pytest.raises(RuntimeError, match="make_pre_post_processors"):
        fresh({TransitionKey.ACTION: near})


def test_wrapping_refuses_what_does_not_fit(act_run, mimicik_run, tmp_path):
    with pytest.raises(ValueError, match="expected a pose"):
        wrap_checkpoint(str(act_run), str(mimicik_run), tmp_path / "a", rotation=PoseFormat.ROTATION_6D)
    with pytest.raises(FileNotFoundError):
        wrap_checkpoint(str(tmp_path / "nothing"), str(mimicik_run), tmp_path / "b")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("mine")
    with pytest.raises(FileExistsError):
        wrap_checkpoint(str(act_run), str(mimicik_run), tmp_path / "full")
    with pytest.raises(ValueError, match="checkpoint of foresight"):
        wrap_checkpoint(str(act_run), str(SHIPPED / "airbot_play"), tmp_path / "a")
    assert not (tmp_path / "a").exists()
