"""Guidance: bounds hold whatever is asked, what can be met is met, and the certificate says what is true."""

import re

import numpy as np
import pytest

from lerobot_mimicik.guidance.certificate import Reason
from lerobot_mimicik.guidance.compilation import is_compiled
from lerobot_mimicik.guidance.guided import Guidance
from lerobot_mimicik.guidance.model import ArmModel, arm_model
from lerobot_mimicik.guidance.settings import GuidanceSettings, PoseTask
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.poses import pose_distance

ARM = describe_arm("airbot_play")
MODEL, HOME = arm_model(ARM), np.array(ARM.home)


def guidance(**settings) -> Guidance:
    return Guidance(MODEL, GuidanceSettings(**settings))


def motion(frames: int, seed: int = 0, amplitude: float = 0.3) -> np.ndarray:
    """Joints (T, dof) of a smooth motion about home."""
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0, 2 * np.pi, 6), rng.uniform(0.05, 0.12, 6)
    t = np.arange(frames)[:, None]
    return HOME + amplitude * (np.sin(speed * t + phase) - np.sin(phase))


def drive(solver: Guidance, targets: np.ndarray, start: np.ndarray, ahead: int = 0) -> np.ndarray:
    q, commands = start, []
    solver.reset(start)
    for t, target in enumerate(targets):
        upcoming = targets[t + 1 : t + 1 + ahead] if ahead else None
        q = solver.solve(q, target, upcoming).q
        commands.append(q)
    return np.array(commands)


def errors_mm(commands, targets):
    return 1e3 * np.array(
        [pose_distance(MODEL.pose(q), target)[0] for q, target in zip(commands, targets, strict=True)]
    )


def targets_of(joints):
    return np.array([MODEL.pose(q) for q in joints])


def jerk(commands):
    return np.abs(np.diff(commands, n=3, axis=0)).mean()


@pytest.mark.parametrize("ahead", [0, 7])
def test_a_motion_within_reach_is_met(ahead):
    joints = motion(80)
    targets = targets_of(joints)
    commands = drive(guidance(), targets, joints[0], ahead)
    assert errors_mm(commands, targets).mean() < 0.2
    assert errors_mm(commands, targets).max() < 2.0


def test_looking_ahead_is_smoother_under_a_trembling_target():
    joints = motion(80) + np.random.default_rng(1).normal(0, 0.002, (80, 6))
    targets = targets_of(joints)
    one, plan = (drive(guidance(), targets, joints[0], ahead) for ahead in (0, 7))
    assert jerk(plan) < 0.7 * jerk(one)


@pytest.mark.parametrize("ahead", [0, 7])
@pytest.mark.parametrize("seed", range(4))
def test_bounds_hold_exactly_whatever_is_asked(seed, ahead):
    rng = np.random.default_rng(seed)
    solver, q = guidance(max_step=0.06), rng.uniform(MODEL.lower, MODEL.upper)
    solver.reset(q)
    for _ in range(25):
        targets = targets_of(rng.uniform(MODEL.lower, MODEL.upper, (1 + ahead, 6)))
        targets[:, :3] *= rng.choice([1.0, 3.0])
        found = solver.solve(q, targets[0], targets[1:] if ahead else None)
        plan = np.concatenate([q[None], found.plan])
        assert np.abs(np.diff(plan, axis=0)).max() <= 0.06 + 1e-12
        assert np.abs(found.q - q).max() <= 0.06 + 1e-12
        for each in (found.q, *found.plan):
            assert ((each >= MODEL.lower - 1e-12) & (each <= MODEL.upper + 1e-12)).all()
        q = found.q


def test_joints_outside_their_limits_come_back_and_are_never_pushed_further_out():
    start = HOME.copy()
    start[2] = MODEL.upper[2] + 0.05
    solver, q = guidance(), start
    target = MODEL.pose(np.clip(start, MODEL.lower, MODEL.upper - 0.1))
    for _ in range(6):
        found = solver.solve(q, target).q
        assert np.abs(found - q).max() <= 0.095 + 1e-12
        assert found[2] <= max(q[2], MODEL.upper[2]) + 1e-12
        q = found
    assert q[2] <= MODEL.upper[2]


def test_the_same_calls_give_the_same_answers():
    targets = targets_of(motion(30))
    first, second = (drive(guidance(), targets, HOME, 7) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_plan_is_never_worse_than_one_frame_after_the_other_by_its_own_cost():
    rng = np.random.default_rng(3)
    joints = motion(60) + rng.normal(0, 0.01, (60, 6))
    targets = targets_of(joints)
    solver, q = guidance(), joints[0]
    solver.reset(q)
    for t in range(40):
        fresh = Guidance(MODEL, solver.settings)
        fresh._past = None if solver._past is None else solver._past.copy()
        alone = fresh.solve(q, targets[t], targets[t + 1 : t + 8])
        found = solver.solve(q, targets[t], targets[t + 1 : t + 8])
        assert found.cost <= alone.cost * (1 + 1e-6)
        q = found.q


# ---- certificates ---------------------------------------------------------------------------------------------


def test_a_target_several_steps_away_is_the_step_bounds_doing():
    found = guidance().solve(HOME, MODEL.pose(HOME + 0.3)).certificate
    assert not found.reached
    assert found.reason is Reason.STEP
    assert found.joints
    assert "several steps" in str(found)


def test_a_target_beyond_a_limit_names_the_joint():
    q = HOME.copy()
    q[4] = MODEL.upper[4]
    beyond = q.copy()
    beyond[4] += 0.15
    found = guidance(branch_distance=0.0).solve(q, MODEL.pose(beyond)).certificate
    assert found.reason is Reason.LIMIT
    assert "joint5" in found.joints
    assert found.limit_margin <= 1e-6


def test_a_target_out_of_reach_says_how_close_the_arm_comes():
    target = MODEL.pose(HOME)
    target[:3] = [1.5, 0.0, 0.3]
    found = guidance().solve(HOME, target).certificate
    assert found.reason in (Reason.REACH, Reason.LIMIT, Reason.SINGULAR)
    assert found.closest is not None
    assert "from here" in str(found)


def test_what_the_certificate_says_of_the_error_is_so():
    rng = np.random.default_rng(2)
    for _ in range(20):
        target = MODEL.pose(HOME + rng.uniform(-0.2, 0.2, 6))
        found = guidance().solve(HOME, target)
        metres, radians = pose_distance(MODEL.pose(found.q), target)
        assert found.certificate.position_error == pytest.approx(metres, abs=1e-9)
        assert found.certificate.rotation_error == pytest.approx(radians, abs=1e-7)
        assert found.certificate.reached == (metres <= 0.002 and radians <= 0.02)


# ---- tasks, prior, users' terms ----------------------------------------------------------------------------


def test_a_free_axis_costs_nothing_and_the_others_are_met():
    task = PoseTask(weight=(1, 1, 1, 1, 1, 0), frame="tool")
    target = MODEL.pose(HOME)
    # Turned about the tool's own z by half a radian: with that axis free there is nothing to do.
    half = np.array([0, 0, np.sin(0.25), np.cos(0.25)])
    x, y, z, w = target[3:]
    a, b, c, d = half
    target[3:] = [
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
        w * d - x * a - y * b - z * c,
    ]
    found = guidance(task=task, clearance=0.0).solve(HOME, target)
    np.testing.assert_allclose(found.q, HOME, atol=1e-3)
    assert found.certificate.reached
    assert not guidance().solve(HOME, target).certificate.reached


def test_within_a_tolerance_the_arm_stays_where_it_comes_to():
    task = PoseTask(tolerance=(0.01, 0, 0, 0, 0, 0))
    target = MODEL.pose(HOME)
    target[0] += 0.03
    solver, q = guidance(task=task), HOME
    for _ in range(30):
        q = solver.solve(q, target).q
    left = np.abs(target - MODEL.pose(q))
    assert 1e-3 < left[0] <= 0.0101
    assert left[1:3].max() < 1e-3


@pytest.mark.parametrize(
    "prior",
    [lambda q, target: q, lambda q, target: q + 0.05, lambda q, target: q - 0.001],
    ids=["still", "far", "off"],
)
def test_a_useless_prior_makes_nothing_worse(prior):
    joints = motion(60)
    targets = targets_of(joints)
    solver, q = guidance(), joints[0]
    solver.reset(q)
    alone = errors_mm(drive(guidance(), targets, joints[0]), targets).mean()
    commands = []
    for target in targets:
        q = solver.solve(q, target, None, prior).q
        commands.append(q)
    assert errors_mm(commands, targets).mean() <= 1.1 * alone


def test_a_prior_that_knows_the_motion_is_trusted_and_makes_it_more_exact():
    joints = motion(60)
    targets = targets_of(joints)
    solver, q, commands, trust = guidance(), joints[0], [], []
    solver.reset(q)
    for t, target in enumerate(targets):
        found = solver.solve(q, target, None, lambda q, target, t=t: joints[t])
        q = found.q
        commands.append(q)
        trust.append(found.trust)
    assert np.mean(trust[1:]) > 0.9
    assert (
        errors_mm(commands, targets).mean()
        < 0.5 * errors_mm(drive(guidance(), targets, joints[0]), targets).mean()
    )


def test_the_elbow_of_seven_joints_goes_where_a_prior_knows_it():
    panda = arm_model(describe_arm("panda"))
    home = np.array(panda.description.home)
    t = np.linspace(0.0, 2.0, 80)[:, None]
    joints = home + 0.3 * np.sin(t) * np.array([1.0, -0.5, -1.2, 0.3, 0.8, 0.2, 0.5])
    found = {}
    for name in ("alone", "known"):
        solver, q = Guidance(panda), joints[0]
        solver.reset(q)
        for i in range(1, len(joints)):
            prior = (lambda q, target, i=i: joints[i]) if name == "known" else None
            q = solver.solve(q, panda.pose(joints[i]), None, prior).q
        found[name] = np.abs(q - joints[-1]).max()
        assert pose_distance(panda.pose(q), panda.pose(joints[-1]))[0] < 1e-3
    assert found["known"] < 0.25 * found["alone"]


def test_a_term_of_the_users_own_is_weighed_with_the_rest():
    def first_joint_stays(joints):
        residual = 3.0 * (joints[:, 0] - HOME[0])
        jacobian = np.zeros((len(joints), *joints.shape))
        for t in range(len(joints)):
            jacobian[t, t, 0] = 3.0
        return residual, jacobian

    targets = targets_of(motion(40))
    plain, own = (
        drive(Guidance(MODEL, terms=terms), targets, HOME, 7) for terms in ((), (first_joint_stays,))
    )
    assert np.abs(own[:, 0] - HOME[0]).max() < 0.5 * np.abs(plain[:, 0] - HOME[0]).max()


def test_a_term_with_wrong_shapes_is_named():
    def broken(joints):
        return np.zeros(2), np.zeros((3, 1, 6))

    with pytest.raises(ValueError, match=r"cost term .*broken.* shapes \(2,\)"):
        Guidance(MODEL, terms=(broken,)).solve(HOME, MODEL.pose(HOME))


# ---- self-collision -----------------------------------------------------------------------------------------


def test_no_command_brings_the_arm_closer_to_itself_than_allowed():
    # Folded in: the tool is led into the base.
    solver, q = guidance(), HOME
    target = MODEL.pose(HOME)
    target[:3] = [0.0, 0.0, 0.1]
    reasons = set()
    for _ in range(60):
        before = MODEL.gap(q)[0]
        found = solver.solve(q, target)
        after = MODEL.gap(found.q)[0]
        assert after >= min(solver.settings.collision_margin, before) - 1e-9
        q = found.q
        reasons.add(found.certificate.reason)
        if found.certificate.reason is Reason.COLLISION:
            assert set(found.certificate.bodies) <= set(MODEL.bodies)
    assert MODEL.gap(q)[0] < 0.05  # it went there
    assert len(MODEL.pairs) > 10


def into_the_base(fraction):
    """The tool's pose at home, moved a part of the way into the base."""
    target = MODEL.pose(HOME)
    target[:3] += fraction * (np.array([0.0, 0.0, 0.1]) - target[:3])
    return target


def test_every_frame_of_a_plan_keeps_the_gap_and_the_plan_names_the_links():
    solver, q = guidance(), HOME
    targets = [into_the_base(fraction) for fraction in np.linspace(0, 1, 30)]
    named = set()
    for t in range(22):
        found = solver.solve(q, targets[t], np.array(targets[t + 1 : t + 8]))
        frames = np.concatenate([q[None], found.plan])
        gaps = np.array([MODEL.gap(frame)[0] for frame in frames])
        assert (gaps[1:] >= np.minimum(solver.settings.collision_margin, gaps[:-1]) - 1e-9).all()
        assert np.abs(np.diff(frames, axis=0)).max() <= 0.095 + 1e-12
        named.add(found.kept_apart)
        q = found.q
    (links,) = named - {None}
    assert set(links) <= set(MODEL.bodies)


@pytest.mark.parametrize("ahead", [0, 7])
def test_a_target_at_which_the_gap_is_allowed_is_met(ahead):
    # Folded until base_link and link6 are 9 mm apart.
    way = HOME + np.linspace(0, 1, 200)[:, None] * (
        np.array([0.074, -0.758, -0.087, 1.999, -0.452, -1.403]) - HOME
    )
    folded = next(q for q in way if MODEL.gap(q)[0] < 0.009)
    assert MODEL.gap(folded)[0] > 0.008
    target = MODEL.pose(folded)
    q, solver = folded, guidance()
    for _ in range(6):
        found = solver.solve(q, target, np.array([target] * ahead) if ahead else None)
        q = found.q
    assert found.certificate.position_error < 0.5e-3


# ---- any arm ------------------------------------------------------------------------------------------------

SLIDER = """<robot name="slider"><link name="b"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="l4"/>
<link name="l5"/><link name="l6"/>
<joint name="rail" type="prismatic"><parent link="b"/><child link="l1"/><axis xyz="1 0 0"/>
<limit lower="-0.5" upper="0.5" effort="1" velocity="1"/></joint>
<joint name="j1" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><parent link="l2"/><child link="l3"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="j3" type="revolute"><parent link="l3"/><child link="l4"/><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2.5" upper="2.5" effort="1" velocity="1"/></joint>
<joint name="j4" type="revolute"><parent link="l4"/><child link="l5"/><origin xyz="0.25 0 0"/><axis xyz="1 0 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="j5" type="revolute"><parent link="l5"/><child link="l6"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.mark.parametrize("ahead", [0, 7])
@pytest.mark.parametrize("name", ["piper", "slider", "seven"])
def test_one_set_of_defaults_serves_other_arms(name, ahead):
    urdf = {"slider": SLIDER, "seven": SLIDER.replace("</robot>", _SEVENTH)}.get(name, name)
    model = ArmModel(describe_arm(urdf))
    middle = model.comfortable() + 0.3 * (np.arange(model.dof) % 2)
    rng = np.random.default_rng(4)
    phase, speed = rng.uniform(0, 2 * np.pi, model.dof), rng.uniform(0.03, 0.1, model.dof)
    joints = middle + 0.2 / np.maximum(model.unit, 1) * np.sin(np.arange(60)[:, None] * speed + phase)
    targets = np.array([model.pose(q) for q in joints])
    solver = Guidance(model)
    q, errors = joints[0], []
    solver.reset(q)
    for t, target in enumerate(targets):
        found = solver.solve(q, target, targets[t + 1 : t + 1 + ahead] if ahead else None)
        q = found.q
        errors.append(found.certificate.position_error)
    assert np.mean(errors) < 0.3e-3
    assert np.max(errors) < 3e-3


_SEVENTH = """<link name="l7"/><joint name="j6" type="revolute"><parent link="l6"/><child link="l7"/>
<origin xyz="0.1 0 0"/><axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"max_stepp": 0.1}, "there is no setting 'max_stepp'. Did you mean max_step?"),
        ({"max_step": "0.1"}, "max_step='0.1': expected a number"),
        ({"max_step": None}, "max_step=None: expected a number"),
        ({"horizon": 2.5}, "horizon=2.5: expected a whole number"),
        ({"horizon": 10**12}, "horizon=1000000000000: expected at most 1000"),
        ({"velocity": float("nan")}, "velocity must be finite"),
        ({"task": {"wait": [1] * 6}}, "there is no setting 'wait'. Did you mean weight?"),
    ],
)
def test_settings_that_do_not_exist_or_do_not_fit_are_named(settings, reason):
    with pytest.raises(ValueError, match=re.escape(reason)):
        GuidanceSettings.of(settings)


def test_it_is_known_whether_the_first_call_will_compile(tmp_path):
    guidance().solve(HOME, MODEL.pose(HOME))
    assert not is_compiled(tmp_path)
    assert is_compiled()
