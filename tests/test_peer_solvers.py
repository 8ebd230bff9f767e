"""Properties of the solvers that stand on other libraries, the same for all of them.

A solver whose package is not installed is skipped with the reason. What is promised to whom: all start
from the measured joints; `BOUNDED` ones keep joint limits and a largest step; `EXACT` ones reach any
target nearby. `placo_lerobot` takes a single step that hardly minds orientation, `least_squares` a single damped
one, and `relaxed_ik` gives way to the motion terms of its cost, so they are held to less.
"""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lerobot_mimicik.guidance.box_step import bounded_step, step_box
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.rotations import pose_error
from lerobot_mimicik.solvers import SolverUnavailable, available_solvers, make_solver, register_solver
from lerobot_mimicik.solvers.availability import Package
from lerobot_mimicik.solvers.base import known_solvers
from lerobot_mimicik.solvers.chain_urdf import TOOL, chain_urdf
from lerobot_mimicik.solvers.iterative import MAX_STEP, posture_of

BOUNDED = (
    "embodik", "jparse", "least_squares", "mink", "optik", "pink", "pinocchio", "placo", "pybullet", "relaxed_ik", "ssik"
)  # fmt: skip
PEERS = (*BOUNDED, "pinocchio_undamped", "placo_lerobot", "placo_lerobot_8")
# Position (m) and rotation (rad) within which a nearby target is reached.
EXACT = (1e-3, np.deg2rad(0.5))
TOLERANCE = dict.fromkeys(PEERS, EXACT) | {
    "placo_lerobot": (5e-3, np.deg2rad(5.0)),
    "placo_lerobot_8": (5e-3, np.deg2rad(5.0)),
    "relaxed_ik": (1e-2, np.deg2rad(5.0)),
    "least_squares": (5e-3, np.deg2rad(1.0)),
}
# How far (rad) a solver may move an arm that is on its target.
AT_REST = dict.fromkeys(PEERS, 1e-4) | {"relaxed_ik": 0.02}
AVAILABLE = available_solvers()
TOOL_OFFSET = (0.16, 0.01, -0.02, 0.3, -0.2, 0.5)


def needs(name: str) -> None:
    """Skip the test where the solver cannot run."""
    if AVAILABLE[name] is not None:
        pytest.skip(f"{name}: {AVAILABLE[name]}")


def an_arm(name: str = "airbot_play", tool: tuple[float, ...] = (), order: tuple[int, ...] = ()) -> SerialArm:
    """A shipped arm in float64, with its joints in another order if one is given."""
    description = describe_arm(name, tool_offset=tool)
    if order:
        names = tuple(description.joint_names[i] for i in order)
        home = tuple(description.home[i] for i in order)
        description = dataclasses.replace(description, joint_names=names, home=home)
    return SerialArm(description, dtype=torch.float64)


def fk(arm: SerialArm, q: np.ndarray) -> np.ndarray:
    """Poses of joints, numpy in and out."""
    return arm.forward(torch.from_numpy(q)).numpy()


def nearby_targets(arm: SerialArm, count: int = 8, step: float = 0.03) -> list[tuple[np.ndarray, np.ndarray]]:
    """Joints around home, away from limits and singularities, and poses a small joint step away."""
    random = np.random.default_rng(3)
    home = np.array(arm.description.home)
    joints = home + random.uniform(-0.25, 0.25, (count, arm.dof))
    goals = fk(arm, joints + random.uniform(-step, step, (count, arm.dof)))
    return list(zip(joints, goals, strict=True))


def reached(arm: SerialArm, q: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Position (m) and rotation (rad) errors of a command."""
    position, angle = pose_error(torch.from_numpy(fk(arm, q)), torch.from_numpy(target))
    return float(position), float(angle)


@pytest.mark.parametrize("tool", [(), TOOL_OFFSET], ids=["flange", "tool"])
@pytest.mark.parametrize("robot", ["airbot_play", "piper"])
@pytest.mark.parametrize("name", PEERS)
def test_a_nearby_target_is_reached(name, robot, tool):
    # Their FK agrees with ours, tool included: the target is ours, and so is the measure.
    needs(name)
    arm = an_arm(robot, tool)
    solver = make_solver(name, arm)
    for q, target in nearby_targets(arm):
        solver.reset(q)
        position, angle = reached(arm, solver.solve(q, target), target)
        assert position < TOLERANCE[name][0]
        assert angle < TOLERANCE[name][1]


@pytest.mark.parametrize("name", PEERS)
def test_where_the_arm_is_already_it_stays(name):
    needs(name)
    arm = an_arm(tool=TOOL_OFFSET)
    solver = make_solver(name, arm)
    for q, _ in nearby_targets(arm, 3):
        solver.reset(q)
        np.testing.assert_allclose(solver.solve(q, fk(arm, q)), q, atol=AT_REST[name])


@pytest.mark.parametrize("name", PEERS)
def test_the_order_of_the_joints_does_not_matter(name):
    needs(name)
    arm, order = an_arm(), (3, 0, 5, 1, 4, 2)
    other = an_arm(order=order)
    one, two = make_solver(name, arm), make_solver(name, other)
    for q, target in nearby_targets(arm, 4):
        one.reset(q)
        two.reset(q[list(order)])
        expected = one.solve(q, target)
        np.testing.assert_allclose(two.solve(q[list(order)], target), expected[list(order)], atol=1e-5)


@pytest.mark.parametrize("name", BOUNDED)
def test_limits_and_the_largest_step_are_kept_whatever_the_target(name):
    needs(name)
    arm = an_arm()
    solver = make_solver(name, arm)
    lower, upper = arm.lower.numpy(), arm.upper.numpy()
    random = np.random.default_rng(5)
    for _ in range(10):
        q = random.uniform(lower, upper)
        # Anywhere in the workspace, mostly not near; the first joints start at a limit.
        q[:2] = lower[:2]
        command = solver.solve(q, fk(arm, random.uniform(lower, upper)))
        assert np.isfinite(command).all()
        assert (np.abs(command - q) <= MAX_STEP + 1e-9).all()
        assert (command >= lower - 1e-6).all()
        assert (command <= upper + 1e-6).all()


@pytest.mark.parametrize("name", ["embodik", "jparse", "mink", "pink", "pinocchio", "placo"])
def test_a_far_target_is_approached(name):
    needs(name)
    arm = an_arm()
    solver = make_solver(name, arm)
    q = np.array(arm.description.home)
    target = fk(arm, q + 0.4)
    before = reached(arm, q, target)[0]
    for _ in range(8):
        q = solver.solve(q, target)
    position, angle = reached(arm, q, target)
    assert position < 0.01 * before
    assert angle < EXACT[1]


@pytest.mark.parametrize("name", BOUNDED)
def test_a_joint_measured_outside_its_limits_is_led_back(name):
    needs(name)
    if name in ("ssik", "optik"):
        pytest.skip(f"{name} only follows solutions within the limits")
    arm = an_arm()
    q = np.array(arm.description.home)
    q[1] = float(arm.upper[1]) + 0.02
    command = make_solver(name, arm).solve(q, fk(arm, q))
    assert command[1] <= float(arm.upper[1]) + 1e-6
    assert np.abs(command - q).max() <= MAX_STEP + 1e-9


@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_continuous_joints_go_round(kind):
    if AVAILABLE["pinocchio"]:
        pytest.skip(AVAILABLE["pinocchio"])
    of_kind = f'name="joint6" type="{kind}"'
    text = describe_arm("airbot_play").urdf.replace('name="joint6" type="revolute"', of_kind)
    description = describe_arm(text, base_link="base_link", tip_link="end_link")
    arm = SerialArm(description, dtype=torch.float64)
    q = np.array(describe_arm("airbot_play").home)
    q[5] = 3.0
    goal = q + np.array([0, 0, 0, 0, 0, 0.08])
    command = make_solver("pinocchio", arm).solve(q, fk(arm, goal))
    expected = goal[5] if kind == "continuous" else float(arm.upper[5])
    assert command[5] == pytest.approx(expected, abs=1e-4)


def test_ssik_holds_where_the_nearest_solution_is_further_than_its_bound():
    needs("ssik")
    arm = an_arm()
    q = np.array(arm.description.home)
    far = fk(arm, q + 0.3)
    np.testing.assert_array_equal(make_solver("ssik", arm, seed_tolerance=0.1).solve(q, far), q)
    assert np.abs(make_solver("ssik", arm).solve(q, far) - q).max() > 0.05


def test_posture_is_home_or_the_middle_of_the_ranges():
    arm = an_arm()
    np.testing.assert_array_equal(posture_of(arm), arm.description.home)
    homeless = SerialArm(dataclasses.replace(arm.description, home=()), dtype=torch.float64)
    np.testing.assert_allclose(posture_of(homeless), (arm.lower + arm.upper) / 2)


@pytest.mark.parametrize("name", ["mink", "pink", "placo"])
def test_the_posture_task_leads_a_singular_wrist_back(name):
    # With the wrist stretched, joints 4 and 6 turn the tool alike: only the posture says which of them to turn.
    needs(name)
    arm = an_arm()
    home = np.array(arm.description.home)
    q = home * np.array([1, 1, 1, 1, 0, 1]) + np.array([0, 0, 0, 0.5, 0, -0.5])
    turned = fk(arm, q + np.array([0, 0, 0, 0, 0, 0.05]))
    option = "posture_weight" if name == "placo" else "posture_cost"
    with_posture = make_solver(name, arm).solve(q, turned)
    without = make_solver(name, arm, **{option: 0.0}).solve(q, turned)
    assert np.abs(with_posture - home)[[3, 5]].sum() < np.abs(without - home)[[3, 5]].sum() - 1e-3


def test_the_bare_chain_is_the_arm():
    # Read back by our own reader, so that it holds for all libraries at once.
    arm = an_arm(tool=TOOL_OFFSET)
    bare = SerialArm(describe_arm(chain_urdf(arm.description)), dtype=torch.float64)
    assert bare.description.tip_link == TOOL
    q = np.random.default_rng(0).uniform(-1, 1, (20, arm.dof))
    np.testing.assert_allclose(fk(bare, q), fk(arm, q), atol=1e-12)
    assert torch.equal(bare.lower, arm.lower)
    assert torch.equal(bare.upper, arm.upper)


def test_pinocchio_agrees_with_our_forward_kinematics():
    needs("pinocchio")
    from lerobot_mimicik.solvers.pinocchio_model import PinocchioModel

    for robot in ("airbot_play", "piper"):
        arm = an_arm(robot, TOOL_OFFSET)
        library = PinocchioModel(arm.description)
        for q, _ in nearby_targets(arm):
            library.error(library.to_model(q), library.target(fk(arm, q)))
            pose = library.data.oMf[library.tool]
            mine = fk(arm, q)
            np.testing.assert_allclose(pose.translation, mine[:3], atol=1e-9)
            np.testing.assert_allclose(pose.rotation, Rotation.from_quat(mine[3:]).as_matrix(), atol=1e-9)


def test_a_bounded_step_is_the_best_in_its_box():
    from scipy.optimize import lsq_linear

    random = np.random.default_rng(0)
    for _ in range(50):
        jacobian, goal = random.normal(size=(6, 6)), random.normal(size=6)
        lower, upper = -random.uniform(0, 0.3, 6), random.uniform(0, 0.3, 6)
        lower[random.integers(6)] = 0.0
        step = bounded_step(jacobian, goal, 1e-12, lower, upper)
        best = lsq_linear(jacobian, goal, bounds=(lower - 1e-12, upper), tol=1e-14, method="bvls")
        np.testing.assert_allclose(step, best.x, atol=1e-6)
    free = bounded_step(jacobian, goal, 0.0, np.full(6, -np.inf), np.full(6, np.inf))
    np.testing.assert_allclose(jacobian @ free, goal, atol=1e-9)


def test_the_box_prefers_the_step_to_the_limit():
    lower, upper = step_box(np.array([0.0, 0.95, 1.3]), -np.ones(3), np.ones(3), 0.1)
    np.testing.assert_allclose(lower, [-0.1, 0.85, 1.2])
    np.testing.assert_allclose(upper, [0.1, 1.0, 1.2])


def test_every_peer_is_listed_whether_it_can_run_or_not():
    assert set(PEERS) <= set(known_solvers())
    assert set(available_solvers()) == set(known_solvers())
    assert AVAILABLE["hold"] is None


def test_a_solver_without_its_package_says_what_to_install():
    package = Package("no_such_ik_library", "uv pip install no-such-ik-library")

    @register_solver("test_absent", needs=(package,))
    def factory(arm):
        raise AssertionError("must not be called")

    reason = available_solvers()["test_absent"]
    assert reason is not None
    assert "no_such_ik_library is not installed: uv pip install" in reason
    with pytest.raises(SolverUnavailable, match=r"'test_absent' is not available.*no-such-ik-library"):
        make_solver("test_absent", an_arm())


def test_ssik_refuses_an_arm_that_it_cannot_solve():
    needs("ssik")
    text = describe_arm("airbot_play").urdf
    short = describe_arm(text, base_link="base_link", tip_link="link5")
    with pytest.raises(SolverUnavailable, match="six or seven revolute joints; this one has 5"):
        make_solver("ssik", SerialArm(short, dtype=torch.float64))


@pytest.mark.parametrize("name", ["embodik", "mink", "pink", "pinocchio", "placo", "ssik"])
def test_a_straight_line_past_the_singular_wrist_is_followed_without_a_jump(name):
    needs(name)
    arm = an_arm()
    home = np.array(arm.description.home)
    start = home + np.array([0, 0, 0, 0.15, 1.25, 0])
    end = home + np.array([0, 0, 0, -0.1, 0.55, 0])
    first, last = fk(arm, start), fk(arm, end)
    share = np.linspace(0, 1, 60)
    line = first + share[:, None] * (last - first)
    line[:, 3:] /= np.linalg.norm(line[:, 3:], axis=1, keepdims=True)
    solver, q, errors = make_solver(name, arm), start, []
    for target in line:
        command = solver.solve(q, target)
        assert np.abs(command - q).max() <= MAX_STEP + 1e-9
        q = command
        errors.append(reached(arm, q, target)[0])
    assert max(errors) < 0.02
    assert errors[-1] < EXACT[0]
