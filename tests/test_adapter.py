"""The adapter: bounded steps, honest statuses, with a numerical solver and with a trained policy."""

import numpy as np
import pytest

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.poses import PoseFormat, encode_pose
from lerobot_mimicik.solvers import make_solver
from lerobot_mimicik.solvers.base import IKSolver
from robot_adapters.adapter import AdapterSettings, IKStatus, MimicIKAdapter

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)


class Silent(IKSolver):
    """A solver that gives up, as real ones do."""

    name = "silent"

    def reset(self, q):
        """Nothing to forget."""

    def solve(self, q_curr, target_pose):
        """Never answers."""
        raise TimeoutError("no answer")


class Wild(Silent):
    """A solver that answers with a configuration far away."""

    name = "wild"

    def solve(self, q_curr, target_pose):
        """Half a turn away."""
        return q_curr + 2.0


def adapter_with(name: str, **settings) -> MimicIKAdapter:
    return MimicIKAdapter(make_solver(name, SerialArm(ARM)), ARM, AdapterSettings(**settings))


@pytest.fixture(scope="module")
def numerical() -> MimicIKAdapter:
    return adapter_with("mink")


@pytest.fixture(autouse=True)
def _forget(numerical):
    numerical.reset()


def test_a_near_target_is_reached(numerical):
    target = numerical.forward(HOME + 0.02)
    result = numerical.solve(HOME, target)
    assert result.status is IKStatus.REACHED
    assert result.source == "mink"
    assert result.position_error < 1e-3
    np.testing.assert_allclose(numerical.forward(result.q)[:3], target[:3], atol=1e-3)


def test_a_far_target_is_approached_step_by_step_and_reached(numerical):
    goal = HOME + np.array([0.6, 0.3, -0.2, 0.3, 0.4, -0.5])
    q, statuses = HOME, []
    for _ in range(60):
        result = numerical.solve(q, numerical.forward(goal))
        assert result.step <= numerical.settings.max_step + 1e-12
        np.testing.assert_allclose(np.abs(result.q - q).max(), result.step, atol=1e-12)
        q = result.q
        statuses.append(result.status)
    assert statuses[0] is IKStatus.LIMITED
    assert statuses[-1] is IKStatus.REACHED


@pytest.mark.parametrize("name", ["mink", "hold"])
def test_a_target_out_of_reach_is_said_so_and_the_arm_stays_at_the_edge(name):
    adapter, q = adapter_with(name), HOME
    target = np.array([1.5, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0])
    results = []
    for _ in range(120):
        results.append(adapter.solve(q, target))
        q = results[-1].q
    assert {result.status for result in results} == {IKStatus.UNREACHABLE}
    assert "mm" in results[-1].message
    assert results[-1].step < 1e-3  # at rest, no chatter
    assert results[-1].position_error < results[0].position_error - 0.2
    assert ((q >= adapter.lower - 1e-9) & (q <= adapter.upper + 1e-9)).all()


def test_a_solver_that_does_nothing_is_told_apart_from_a_target_out_of_reach():
    adapter = adapter_with("hold")
    q, target = HOME, adapter.forward(HOME + 0.3)
    for _ in range(40):
        result = adapter.solve(q, target)
        q = result.q
    assert result.status in (IKStatus.RELAXED, IKStatus.REACHED)
    assert result.position_error < adapter.settings.relaxed_position


# Joint 3 at its limit behind the elbow singularity; the same targets lie before it as well.
CAUGHT = np.array([0.51, -1.78, ARM.joints()[2].upper, 1.41, -1.59, -1.84])
BEFORE = np.array([0.51, -1.33, 2.26, 1.40, -1.14, -1.77])


def test_an_arm_caught_at_a_joint_limit_goes_to_the_branch_that_follows_the_target():
    adapter, q = adapter_with("hold"), CAUGHT
    # The way out: the joints before the singularity, stretched further frame by frame.
    motion = [BEFORE + share * np.array([-0.1, 0.4, -0.9, 0.0, 0.2, 0.0]) for share in np.linspace(0, 1, 40)]
    results = []
    for joints in motion:
        results.append(adapter.solve(q, adapter.forward(joints)))
        q = results[-1].q
    changing = [result for result in results if result.source == "branch"]
    assert 8 <= len(changing) <= 20
    assert all(result.status is IKStatus.LIMITED and "limit" in result.message for result in changing)
    assert max(result.step for result in results) <= adapter.settings.max_step + 1e-12
    assert max(result.position_error for result in results) < 0.04
    assert results[-1].position_error < 0.005
    assert np.abs(q - motion[-1]).max() < 0.05


def test_without_changes_of_branch_the_arm_stays_and_says_so():
    adapter, q = adapter_with("hold", branch_distance=0.0), CAUGHT
    for share in np.linspace(0, 1, 40):
        result = adapter.solve(
            q, adapter.forward(BEFORE + share * np.array([-0.1, 0.4, -0.9, 0.0, 0.2, 0.0]))
        )
        q = result.q
    assert result.status is IKStatus.UNREACHABLE
    assert result.position_error > 0.05


def test_no_branch_is_changed_for_a_target_that_none_reaches():
    adapter, q = adapter_with("hold"), CAUGHT
    beyond = adapter.forward(BEFORE) + np.array([1.0, 0, 0, 0, 0, 0, 0])
    for _ in range(20):
        result = adapter.solve(q, beyond)
        q = result.q
        assert result.status is IKStatus.UNREACHABLE


def test_a_change_of_branch_ends_with_a_new_motion():
    adapter = adapter_with("hold")
    assert adapter.solve(CAUGHT, adapter.forward(BEFORE)).source == "branch"
    adapter.reset()
    assert adapter.solve(HOME, adapter.forward(HOME)).status is IKStatus.REACHED


@pytest.mark.parametrize("solver", [Silent(), Wild()])
def test_no_solver_can_make_it_jump(solver):
    adapter = MimicIKAdapter(solver, ARM)
    result = adapter.solve(HOME, adapter.forward(HOME + 0.02))
    assert result.step <= adapter.settings.max_step + 1e-12
    if isinstance(solver, Wild):
        assert result.status is not IKStatus.REACHED
    else:
        assert result.status is IKStatus.FAILED
        assert "no answer" in result.message
        np.testing.assert_array_equal(result.q, HOME)


@pytest.mark.parametrize("target", [[np.nan] * 7, [0.3, 0, 0.3, 0, 0, 0, 0], [np.inf, 0, 0, 0, 0, 0, 1]])
def test_a_target_that_is_no_pose_holds_the_arm(numerical, target):
    moved = numerical.solve(HOME, numerical.forward(HOME + 0.02))
    result = numerical.solve(moved.q, target)
    assert result.status is IKStatus.FAILED
    np.testing.assert_array_equal(result.q, moved.q)


def test_wrong_shapes_and_measurements_are_errors(numerical):
    target = numerical.forward(HOME)
    with pytest.raises(ValueError, match="joint1"):
        numerical.solve(HOME[:5], target)
    with pytest.raises(ValueError, match="x y z qx qy qz qw"):
        numerical.solve(HOME, target[:6])
    with pytest.raises(ValueError, match="not finite"):
        numerical.solve(np.full(6, np.nan), target)


def test_steps_start_from_the_command_while_the_arm_follows_it():
    target = adapter_with("mink").forward(HOME + 0.06)
    for reference, expected in (("commanded", True), ("measured", False)):
        adapter = adapter_with("mink", reference=reference, max_step=0.02)
        first = adapter.solve(HOME, target)
        second = adapter.solve(HOME, target)  # an arm that has not moved yet
        assert bool(np.abs(second.q - HOME).max() > 0.03) is expected
        assert np.abs(second.q - first.q).max() <= 0.02 + 1e-12


def test_a_command_that_the_arm_did_not_take_is_forgotten():
    adapter = adapter_with("mink", max_step=0.02)
    target = adapter.forward(HOME + 0.06)
    adapter.solve(HOME, target)
    adapter.commanded(HOME)  # a safety layer refused
    assert np.abs(adapter.solve(HOME, target).q - HOME).max() <= 0.02 + 1e-12
    adapter.solve(HOME, target)
    away = HOME + 0.6  # pushed by hand
    assert np.abs(adapter.solve(away, target).q - away).max() <= 0.02 + 1e-12


def test_settings_out_of_range_are_named():
    with pytest.raises(ValueError, match="reference='both'"):
        AdapterSettings(reference="both")
    with pytest.raises(ValueError, match="max_step"):
        AdapterSettings(max_step=0.0)


def test_a_trained_policy_tracks_a_path(mimicik_run):
    adapter = MimicIKAdapter.from_pretrained(mimicik_run)
    assert adapter.joint_names == ARM.joint_names
    q, errors = HOME, []
    for frame in range(120):
        wanted = HOME + 0.2 * np.sin(frame / 25) * np.array([1, 0.5, -0.5, 0.4, 0.6, 0.3])
        result = adapter.solve(q, adapter.forward(wanted))
        assert result.step <= adapter.settings.max_step + 1e-12
        q = result.q
        errors.append(result.position_error)
    assert np.mean(errors) < 0.006
    assert np.max(errors) < 0.03


def test_a_checkpoint_that_is_none_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config\.json"):
        MimicIKAdapter.from_pretrained(tmp_path)


# --- Wrapped policies ---


def ahead(observation):
    """An end-effector policy: five millimetres further in x, and the gripper half open."""
    pose = observation["observation.state"][:7].copy()
    pose[0] += 0.005
    return np.append(pose, 0.03)


def test_wrap_a_function_with_a_gripper(numerical):
    policy = numerical.wrap(ahead)
    state = np.append(HOME, 0.01)
    action = policy.select_action({"observation.state": state})
    assert action.shape == (7,)
    assert action[6] == 0.03
    assert policy.result is not None
    moved = numerical.forward(action[:6])[:3] - numerical.forward(HOME)[:3]
    np.testing.assert_allclose(moved, [0.005, 0, 0], atol=1e-3)


class Remote:
    """A chunk-producing VLA behind a client: poses relative to the tool when it was asked."""

    def __init__(self):
        self.asked = 0

    def infer(self, observation):
        """Four steps of two millimetres ahead."""
        self.asked += 1
        steps = np.zeros((4, 6))
        steps[:, 0] = 0.002 * np.arange(1, 5)
        return {"actions": steps}


def test_chunks_are_used_up_and_refer_to_the_pose_at_which_they_were_asked():
    from lerobot_mimicik.kinematics.poses import PolicyFrames, PoseReference

    adapter, remote = adapter_with("mink"), Remote()
    frames = PolicyFrames(form=PoseFormat.ROTATION_VECTOR, reference=PoseReference.TOOL)
    policy = adapter.wrap(remote, frames, actions_per_chunk=3)
    q, start = HOME, adapter.forward(HOME)
    for step in range(1, 4):
        q = policy.select_action({"observation.state": q})
        np.testing.assert_allclose(
            np.linalg.norm(adapter.forward(q)[:3] - start[:3]), 0.002 * step, atol=1e-3
        )
    assert remote.asked == 1
    policy.select_action({"observation.state": q})
    assert remote.asked == 2
    policy.reset()
    policy.select_action({"observation.state": q})
    assert remote.asked == 3


@pytest.mark.parametrize("form", PoseFormat)
def test_every_pose_format_leads_to_the_same_joints(numerical, form):
    from lerobot_mimicik.kinematics.poses import PolicyFrames

    target = numerical.forward(HOME + 0.02)
    policy = numerical.wrap(lambda observation: encode_pose(target, form), PolicyFrames(form=form))
    q = policy.select_action({"observation.state": HOME})
    np.testing.assert_allclose(numerical.forward(q)[:3], target[:3], atol=1e-3)


@pytest.mark.parametrize(
    ("answer", "message"),
    [(np.zeros(5), "shape"), (np.zeros((0, 7)), "shape"), ({"poses": 1}, "expected 'actions'")],
)
def test_an_answer_that_is_no_pose_is_named(numerical, answer, message):
    with pytest.raises(ValueError, match=message):
        numerical.wrap(lambda observation: answer).select_action({"observation.state": HOME})


def test_a_policy_that_answers_nan_holds_the_arm(numerical):
    policy = numerical.wrap(lambda observation: np.full(7, np.nan))
    np.testing.assert_array_equal(policy.select_action({"observation.state": HOME}), HOME)
    assert policy.result.status is IKStatus.FAILED


def test_what_is_no_policy_is_named(numerical):
    with pytest.raises(TypeError, match="int is no end-effector policy"):
        numerical.wrap(3)
    with pytest.raises(KeyError, match=r"observation\.state"):
        numerical.wrap(ahead).select_action({"state": HOME})


def test_wrap_a_lerobot_policy(act_run, mimicik_run):
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    path = act_run / "checkpoints" / "last" / "pretrained_model"
    config = PreTrainedConfig.from_pretrained(path)
    pre, post = make_pre_post_processors(config, pretrained_path=str(path))
    adapter = MimicIKAdapter.from_pretrained(mimicik_run)
    act = ACTPolicy.from_pretrained(path).eval()
    policy = adapter.wrap(act, preprocessor=pre, postprocessor=post)
    policy.reset()
    q = HOME
    for _ in range(15):
        environment = adapter.forward(q)
        action = policy.select_action({"observation.state": q, "observation.environment_state": environment})
        assert np.abs(action - q).max() <= adapter.settings.max_step + 1e-9
        q = action
    assert policy.result.status is not IKStatus.FAILED
