"""The adapter: bounded steps, honest statuses, with a numerical solver and with a trained policy."""

import pickle
import threading
import time

import numpy as np
import pytest
import torch

from lerobot_mimicik.guidance.certificate import Reason
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
    assert "from here" in results[-1].message
    assert "mm" in results[-1].message
    assert results[-1].step < 1e-3  # at rest, no chatter
    assert results[-1].position_error < results[0].position_error - 0.2
    assert ((q >= adapter.lower - 1e-9) & (q <= adapter.upper + 1e-9)).all()


def test_where_its_own_body_keeps_the_arm_off_a_target_the_bodies_are_named():
    adapter = MimicIKAdapter.for_arm("airbot_play")
    q = np.array([-0.14, -1.41, 0.13, -1.48, 1.22, -2.46])
    target = adapter.forward([-0.42, -1.62, 0.06, -1.83, 1.55, -2.02])  # the gripper in the base
    for _ in range(60):
        result = adapter.solve(q, target)
        q = result.q
    assert result.step < 1e-3
    assert (result.status, result.certificate.reason) == (IKStatus.UNREACHABLE, Reason.COLLISION)
    assert result.certificate.bodies == ("base_link", "link6")
    assert f"{result.position_error * 1e3:.1f} mm" in result.message


def test_a_solver_that_does_nothing_is_told_apart_from_a_target_out_of_reach():
    adapter = adapter_with("hold")
    q, target = HOME, adapter.forward(HOME + 0.3)
    for _ in range(40):
        result = adapter.solve(q, target)
        q = result.q
    assert result.status in (IKStatus.INEXACT, IKStatus.REACHED)
    assert result.position_error < 0.005


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
    under_way = [result for result in changing if result.status is not IKStatus.REACHED]
    assert len(under_way) >= len(changing) - 2  # the last ones meet the target
    assert all(result.status is IKStatus.LIMITED and "limit" in result.message for result in under_way)
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
        assert result.source != "wild"
    else:
        assert result.status is IKStatus.FAILED
        assert "no answer" in result.message
        np.testing.assert_array_equal(result.q, HOME)


class Answering(Silent):
    """A solver that calls a function of q and target, and counts its resets."""

    name = "answering"

    def __init__(self, function):
        self.function, self.resets = function, 0

    def reset(self, q):
        """Counts."""
        self.resets += 1

    def solve(self, q_curr, target_pose):
        """Whatever the function does."""
        return self.function(q_curr, target_pose)


def answering(function, **settings) -> MimicIKAdapter:
    return MimicIKAdapter(Answering(function), ARM, AdapterSettings(**settings))


def raising(error):
    def solve(q, target):
        raise error

    return solve


@pytest.mark.parametrize("off", [0.01, 0.03, 0.2, 1.0])
def test_what_meets_its_target_is_reached_whoever_found_it(off):
    rng, statuses = np.random.default_rng(0), set()
    adapter = answering(lambda q, target: q + off * rng.uniform(-1, 1, q.shape))
    for _ in range(60):
        target = adapter.forward(HOME + rng.uniform(-1, 1, 6) * rng.choice([0.02, 0.09, 0.5]))
        adapter.reset()
        result = adapter.solve(HOME, target)
        met = result.position_error <= 0.002 and result.rotation_error <= 0.02
        assert met == (result.status is IKStatus.REACHED), result
        assert (result.message == "") == met
        statuses.add(result.status)
    assert {IKStatus.REACHED, IKStatus.LIMITED} <= statuses


def test_the_former_name_of_a_status_still_names_it():
    assert IKStatus.RELAXED is IKStatus.INEXACT
    assert IKStatus("relaxed") is IKStatus.INEXACT
    assert [status.value for status in IKStatus] == ["reached", "inexact", "limited", "unreachable", "failed"]


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ([np.nan] * 7, "not finite"),
        ([0.3, 0, 0.3, 0, 0, 0, 0], "quaternion"),
        ([np.inf, 0, 0, 0, 0, 0, 1], "not finite"),
        ([1e308, 1e308, 0.3, 0, 0, 0, 1], "reach"),
        ([300.0, 0, 300.0, 0, 0, 0, 1], "millimetres"),
    ],
)
def test_a_target_that_is_no_pose_of_the_arm_holds_it(numerical, target, message):
    moved = numerical.solve(HOME, numerical.forward(HOME + 0.02))
    result = numerical.solve(moved.q, target)
    assert result.status is IKStatus.FAILED
    assert message in result.message
    np.testing.assert_array_equal(result.q, moved.q)


@pytest.mark.parametrize("length", [0.5, 1e160, 1e308])
def test_a_quaternion_may_have_any_length(numerical, length):
    target = numerical.forward(HOME + 0.02) * np.array([1, 1, 1, *[length] * 4])
    assert numerical.solve(HOME, target).status is IKStatus.REACHED


def test_a_quaternion_in_another_order_is_hinted_at(numerical):
    target = numerical.forward(HOME + 0.02)[[0, 1, 2, 6, 3, 4, 5]]
    result = numerical.solve(HOME, target)
    assert result.status is not IKStatus.REACHED
    assert "w x y z" in result.message


@pytest.mark.parametrize(
    "error", [KeyError("k"), TypeError("t"), OSError("o"), MemoryError(), StopIteration()]
)
def test_whatever_a_solver_raises_the_arm_holds(error):
    adapter = answering(raising(error))
    result = adapter.solve(HOME, adapter.forward(HOME + 0.02))
    assert result.status is IKStatus.FAILED
    assert (str(error) or type(error).__name__) in result.message
    np.testing.assert_array_equal(result.q, HOME)


@pytest.mark.parametrize(
    "answer",
    [None, "joints", 0.3, [], HOME[:5], HOME[:, None], HOME[None], np.full(6, np.nan), {"q": 1}, 1j * HOME],
)
def test_an_answer_that_is_no_joints_holds_the_arm(answer):
    adapter = answering(lambda q, target: answer)
    result = adapter.solve(HOME, adapter.forward(HOME + 0.02))
    assert result.status is IKStatus.FAILED
    assert "answering: " in result.message
    np.testing.assert_array_equal(result.q, HOME)


def test_a_solver_that_failed_begins_anew_and_the_command_stays_in_force():
    broken = []

    def solve(q, target):
        if broken:
            raise RuntimeError("the server is gone")
        return q + 0.01

    adapter = answering(solve)
    target = adapter.forward(HOME + 0.1)
    moved = adapter.solve(HOME, target)
    broken.append(True)
    for _ in range(3):
        held = adapter.solve(HOME, target)
        assert held.status is IKStatus.FAILED
        np.testing.assert_array_equal(held.q, moved.q)
    known = adapter.solver.resets
    broken.clear()
    again = adapter.solve(HOME, target)
    assert again.status is not IKStatus.FAILED
    assert np.abs(again.q - moved.q).max() <= adapter.settings.max_step
    assert adapter.solver.resets == known + 1
    adapter.solve(HOME, target)
    assert adapter.solver.resets == known + 1


def test_nobody_elses_arrays_are_changed_or_kept():
    kept = HOME.copy()

    def scribble(q, target):
        q += 0.5
        target[:] = 0
        kept[:] = q
        return kept

    adapter = answering(scribble)
    q, target = HOME.copy(), adapter.forward(HOME + 0.05)
    given = target.copy()
    first = adapter.solve(q, target)
    np.testing.assert_array_equal(q, HOME)
    np.testing.assert_array_equal(target, given)
    assert np.abs(first.q - HOME).max() <= adapter.settings.max_step + 1e-12
    before = first.q.copy()
    q[:] = kept[:] = 9.0  # the caller reuses its array, the solver its own
    np.testing.assert_array_equal(first.q, before)
    first.q[:] = 9.0  # and so may who got the command
    second = adapter.solve(HOME, target)
    assert np.abs(second.q - before).max() <= adapter.settings.max_step + 1e-12
    sent = before.copy()
    adapter.commanded(sent)
    sent[:] = 9.0
    third = adapter.solve(HOME, target)
    assert np.abs(third.q - before).max() <= adapter.settings.max_step + 1e-12


def test_from_several_threads_the_commands_follow_each_other():
    inside, overlaps = [], []

    def solve(q, target):
        inside.append(1)
        overlaps.append(len(inside) > 1)
        time.sleep(1e-4)  # lets another thread in, if it may
        inside.pop()
        return q + 1.0

    adapter, results = answering(solve, max_step=0.01, resync=10.0), []
    target = adapter.forward(HOME + 0.3)

    def drive():
        for _ in range(20):
            results.append(adapter.solve(HOME, target).q)

    threads = [threading.Thread(target=drive) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not any(overlaps)
    # Each from the one before, none from the same: the same commands as from one thread.
    alone = answering(solve, max_step=0.01, resync=10.0)
    expected = [alone.solve(HOME, target).q for _ in results]
    by_sum = [sorted(commands, key=lambda q: float(q.sum())) for commands in (results, expected)]
    np.testing.assert_allclose(*by_sum, atol=1e-9)


def test_it_goes_to_another_process_as_it_is():
    adapter = MimicIKAdapter(Wild(), ARM, AdapterSettings(max_step=0.02))
    target = adapter.forward(HOME + 0.2)
    adapter.solve(HOME, target)
    copy = pickle.loads(pickle.dumps(adapter))
    np.testing.assert_array_equal(copy.solve(HOME, target).q, adapter.solve(HOME, target).q)


def test_joints_in_degrees_are_refused(numerical):
    with pytest.raises(ValueError, match=r"joint4 is 90 rad.* degrees"):
        numerical.solve(np.degrees(HOME), numerical.forward(HOME))
    # A little outside the limits, as zeros and sagging servos are, is no reason.
    outside = HOME.copy()
    outside[2] = numerical.upper[2] + 0.1
    assert numerical.solve(outside, numerical.forward(HOME)).status is not IKStatus.FAILED


def test_torch_tensors_are_numbers_too(numerical):
    target = torch.tensor(numerical.forward(HOME + 0.02), requires_grad=True)
    assert numerical.solve(torch.tensor(HOME), target).status is IKStatus.REACHED


def test_wrong_shapes_and_measurements_are_errors(numerical):
    target = numerical.forward(HOME)
    with pytest.raises(ValueError, match="joint1"):
        numerical.solve(HOME[:5], target)
    with pytest.raises(ValueError, match="x y z qx qy qz qw"):
        numerical.solve(HOME, target[:6])
    with pytest.raises(ValueError, match="not finite"):
        numerical.solve(np.full(6, np.nan), target)
    with pytest.raises(ValueError, match="the target"):
        numerical.solve(HOME, {"x": 0.3})
    with pytest.raises(ValueError, match="commanded joints are not finite"):
        numerical.commanded(np.full(6, np.nan))
    with pytest.raises(ValueError, match="commanded joints: expected 6"):
        numerical.commanded(HOME[:1])


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


class OnlyChunks(torch.nn.Module):
    """A LeRobot policy that predicts chunks, and nothing else."""

    def predict_action_chunk(self, batch):
        """Two poses, five and ten millimetres ahead in x."""
        assert batch["observation.state"].shape == (1, 7)
        assert batch["observation.images.top"].shape == (1, 3, 4, 4)
        ahead = torch.tensor([[0.005], [0.010]]) * torch.eye(7)[0]
        return batch["observation.state"][:, None] + ahead


def test_a_policy_with_chunks_only_is_asked_for_them(numerical):
    policy = numerical.wrap(OnlyChunks())
    for image, batched in ((np.zeros((3, 4, 4)), False), (np.zeros((1, 3, 4, 4)), True)):
        policy.reset()
        q, start = HOME, numerical.forward(HOME)
        for step in (1, 2):
            state = q[None] if batched else q
            q = policy.select_action({"observation.state": state, "observation.images.top": image})
            np.testing.assert_allclose(numerical.forward(q)[0] - start[0], 0.005 * step, atol=1e-3)


@pytest.mark.parametrize("batched", [False, True])
def test_torch_answers_with_gradients_and_batches_of_one_chunk(numerical, batched):
    def vla(observation):
        assert observation["observation.state"].shape == ((1, 7) if batched else (7,))
        pose = torch.as_tensor(observation["observation.state"]).reshape(7)
        chunk = pose + 0.003 * torch.arange(1, 17)[:, None] * torch.eye(7)[0]
        return {"actions": torch.nn.Parameter(chunk[None].to(torch.bfloat16 if batched else torch.float64))}

    policy = numerical.wrap(vla, actions_per_chunk=2)
    q = torch.as_tensor(HOME[None] if batched else HOME)
    command = policy.select_action({"observation.state": q})
    assert command.shape == (6,)
    moved = numerical.forward(command)[0] - numerical.forward(HOME)[0]
    assert abs(moved - 0.003) < (0.004 if batched else 1e-3)  # bfloat16 has three digits


@pytest.mark.parametrize("form", PoseFormat)
def test_every_pose_format_leads_to_the_same_joints(numerical, form):
    from lerobot_mimicik.kinematics.poses import PolicyFrames

    target = numerical.forward(HOME + 0.02)
    policy = numerical.wrap(lambda observation: encode_pose(target, form), PolicyFrames(form=form))
    q = policy.select_action({"observation.state": HOME})
    np.testing.assert_allclose(numerical.forward(q)[:3], target[:3], atol=1e-3)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros(5), "shape"),
        (np.zeros((0, 7)), "shape"),
        (np.zeros((2, 16, 7)), r"\(2, 16, 7\).*rotation_6d"),
        ({"poses": 1}, "expected 'actions'"),
        ("ahead", "str, not with numbers"),
    ],
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
    with pytest.raises(ValueError, match=r"one arm.*\(2, 6\)"):
        numerical.wrap(ahead).select_action({"observation.state": np.tile(HOME, (2, 1))})
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
