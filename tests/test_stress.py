"""Properties of the stress sets, on arms of six joints, of five and one that slides, and of seven."""

from functools import cache

import numpy as np
import pytest

from lerobot_mimicik.cli.make_dataset import main
from lerobot_mimicik.data.home import with_home
from lerobot_mimicik.data.stress.closest import closest_poses, descend, pose_cost
from lerobot_mimicik.data.stress.sets import KINDS, make_stress, stress_cases
from lerobot_mimicik.data.writer import CLEAN_KEY, CLOSEST_KEY
from lerobot_mimicik.evaluation.trajectories import load_trajectories
from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.tremor import tremor

FPS = 20


def chain_arm(joints: list[tuple[str, str]]) -> ArmDescription:
    """An arm of links of 0.15 m with these joint types and axes; no home, no collision shapes."""
    parts = ['<link name="l0"/>']
    for i, (kind, axis) in enumerate(joints):
        upper = 0.2 if kind == "prismatic" else 2.5
        parts.append(
            f'<link name="l{i + 1}"/><joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="0.03 0 0.15"/><axis xyz="{axis}"/>'
            f'<limit lower="{0.0 if kind == "prismatic" else -upper}" upper="{upper}" effort="1" velocity="1"/></joint>'
        )
    return describe_arm(f'<robot name="r">{"".join(parts)}</robot>')


Z, Y, X = "0 0 1", "0 1 0", "1 0 0"
ARMS = {
    "six": describe_arm("airbot_play"),
    "five, one slides": chain_arm([("revolute", Z), ("revolute", Y), ("prismatic", X), ("revolute", Y), ("revolute", X)]),
    "seven": chain_arm([("revolute", axis) for axis in (Z, Y, Z, Y, Z, Y, X)]),
}  # fmt: skip


@cache
def made(arm: str, kind: str):
    return stress_cases(ARMS[arm], kind, 1, 12.0, FPS, seed=3)


def distance(a, b):
    return np.linalg.norm(a[:, :3] - b[:, :3], axis=1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ARMS)
def test_every_set_exists_for_every_arm_and_its_reference_meets_the_clean_target(name, kind):
    arm, cases = made(name, kind)
    for case in cases:
        lower, upper = arm.limits
        assert ((case.action >= lower - 1e-9) & (case.action <= upper + 1e-9)).all()
        assert np.isfinite(case.asked).all()
        meets = (
            np.ones(len(case.asked), bool)
            if case.closest is None
            else distance(case.closest, case.asked) < 1e-6
        )
        # Out of reach and on the way back the reference follows with a bounded step.
        if kind != "out-of-reach":
            assert distance(arm.pose(case.action), case.clean)[meets].max() < 1e-6
        if kind != "reclutching":
            assert np.abs(np.diff(case.action, axis=0)).max() < 0.1


def test_the_same_seed_gives_the_same_and_another_seed_another():
    again, other = (stress_cases(ARMS["six"], "splices", 1, 12.0, FPS, seed)[1][0] for seed in (3, 4))
    here = made("six", "splices")[1][0]
    assert np.array_equal(here.asked, again.asked)
    assert not np.allclose(here.asked, other.asked)


def test_tremor_has_its_size_and_its_band_and_its_sets_share_the_motion():
    wave = tremor(400, FPS, 2.0, np.random.default_rng(0))
    assert np.sqrt((wave[:, :3] ** 2).sum(1).mean()) == pytest.approx(2e-3)
    assert np.degrees(np.sqrt((wave[:, 3:] ** 2).sum(1).mean())) == pytest.approx(1.0)
    power = (np.abs(np.fft.rfft(wave, axis=0)) ** 2).sum(1)
    frequency = np.fft.rfftfreq(400, 1 / FPS)
    assert power[(frequency < 3) | (frequency > 9)].sum() < 1e-9 * power.sum()
    half, double = (made("six", kind)[1][0] for kind in ("tremor-0.5mm", "tremor-2mm"))
    assert np.array_equal(half.clean, double.clean)
    np.testing.assert_allclose(
        4 * (half.asked - half.clean)[:, :3], (double.asked - double.clean)[:, :3], atol=1e-12
    )
    still = made("six", "tremor-0mm")[1][0]
    assert np.allclose(still.asked, still.clean)


def test_seams_jump_by_at_most_20_mm_and_lie_8_to_16_poses_apart():
    case = made("six", "splices")[1][0]
    offset = (case.asked - case.clean)[:, :3]
    jumps = np.linalg.norm(np.diff(offset, axis=0), axis=1)
    seams = np.flatnonzero(jumps > 1e-9)
    assert jumps.max() <= 0.02
    assert set(np.diff(seams)) <= set(range(8, 17))


def test_the_target_rests_while_the_hand_is_off_and_then_jumps():
    step = distance(*(lambda t: (t[1:], t[:-1]))(made("six", "reclutching")[1][0].asked))
    # Within the episode it holds at least 0.4 s and jumps further than in any frame of plain motion.
    rest = max(len(run) for run in "".join("." if s < 1e-9 else "|" for s in step).split("|"))
    assert rest >= 0.4 * FPS - 2
    assert step.max() > 0.03


def test_starts_lie_outside_the_limits_by_at_most_three_degrees():
    arm, cases = made("six", "outside-limits")
    lower, upper = arm.limits
    for case in cases:
        excess = np.maximum(lower - case.state, case.state - upper).max(axis=1)
        assert np.radians(0.4) < excess[0] <= np.radians(3.0)
        assert excess[1:].max() <= 0


def test_no_configuration_is_nearer_than_the_closest_pose():
    arm, cases = made("six", "out-of-reach")
    case = cases[0]
    away = np.flatnonzero(distance(case.closest, case.asked) > 5e-3)
    assert 0.1 < len(away) / len(case.asked) < 0.9
    frames = away[:: max(1, len(away) // 12)]
    rng = np.random.default_rng(1)
    gap = closest_poses(arm, case.action[frames], case.asked[frames], rng)
    best = distance(gap, case.asked[frames])
    for _ in range(3):
        q = descend(arm, rng.uniform(arm.lower, arm.upper, (len(frames), 6)), case.asked[frames])
        assert (distance(arm.pose(q), case.asked[frames]) > 0.98 * best - 1e-3).all()
        assert (pose_cost(arm, q, case.asked[frames]) > 0).all()


def test_near_singular_motion_passes_close_to_singularities():
    arm, cases = made("six", "near-singular")
    everyday = made("six", "tremor-0mm")[1][0]

    def smallest(case):
        return np.linalg.svd(arm.jacobian(case.action), compute_uv=False)[:, -1].min()

    assert smallest(cases[0]) < 0.3 * smallest(everyday)


def test_a_found_home_is_inside_the_limits_and_always_the_same():
    found = [with_home(ARMS["seven"]).home for _ in range(2)]
    assert found[0] == found[1]
    assert np.abs(found[0]).max() < 2.5
    assert with_home(ARMS["six"]) is ARMS["six"]


def test_sets_are_datasets_that_evaluation_reads_with_their_columns(tmp_path):
    kinds = ("tremor-1mm", "out-of-reach")
    summary = make_stress(tmp_path, ARMS["six"], kinds=kinds, episodes=1, seconds=10.0)
    assert "tremor-1mm: 1 episodes, 200 frames" in str(summary)
    import torch

    arm = SerialArm(ARMS["six"], dtype=torch.float64)
    shaking, beyond = (load_trajectories(tmp_path / kind, arm).trajectories[0] for kind in kinds)
    assert 0.5e-3 < distance(shaking.clean, shaking.target).mean() < 2e-3
    assert shaking.closest is None
    assert distance(beyond.closest, beyond.target).max() > 5e-3
    assert {CLEAN_KEY, CLOSEST_KEY} == {"observation.ee_target_clean", "observation.ee_target_closest"}


def test_recorded_motion_is_made_to_tremble_and_stays_as_the_clean_target(tmp_path):
    make_stress(tmp_path / "own", ARMS["six"], kinds=["splices"], episodes=2, seconds=5.0)
    options = ["--source=stress", f"--input={tmp_path / 'own' / 'splices'}", f"--output={tmp_path / 'made'}"]
    urdf = tmp_path / "six.urdf"
    urdf.write_text(ARMS["six"].urdf)
    assert main([*options, f"--arm={urdf}", "--stress.kinds=splices"]) == 2
    assert main([*options, f"--arm={urdf}"]) == 0
    import torch

    arm = SerialArm(ARMS["six"], dtype=torch.float64)
    recorded = load_trajectories(tmp_path / "own" / "splices", arm).trajectories
    size = {}
    for mm in (0, 0.5, 1, 2):
        made = load_trajectories(tmp_path / "made" / f"tremor-{mm:g}mm", arm).trajectories
        assert len(made) == len(recorded) == 2
        for one, other in zip(made, recorded, strict=True):
            np.testing.assert_allclose(one.clean, other.target, atol=1e-6)
            np.testing.assert_array_equal(one.q, other.q)
        size[mm] = 1e3 * np.sqrt((distance(made[0].clean, made[0].target) ** 2).mean())
    assert size[0] == 0
    assert size[1] == pytest.approx(1.0, abs=1e-3)
    assert size[2] == pytest.approx(2 * size[1], rel=1e-3)
