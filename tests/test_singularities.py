"""Singularity measures: zero where rank is lost, found on demand, in any joint order."""

import numpy as np
import pytest

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.teleoperation.hand_tracking import ROTATION_LENGTH_M, weighted
from lerobot_mimicik.data.teleoperation.singularities import (
    KINDS,
    SingularityGauge,
    find_singular,
    lost_directions,
)
from lerobot_mimicik.kinematics.arms import describe_arm


def _gauge(name, **options):
    return SingularityGauge.for_arm(ArmArrays(describe_arm(name, **options)), np.random.default_rng(0))


@pytest.fixture(scope="module", params=["airbot_play", "piper"])
def gauge(request):
    return _gauge(request.param)


def test_the_measures_of_the_airbot_play_are_its_known_singularities():
    gauge = _gauge("airbot_play")
    rng = np.random.default_rng(1)
    q = rng.uniform(gauge.arm.lower, gauge.arm.upper, size=(200, 6))
    measures = gauge(q)
    np.testing.assert_allclose(measures["wrist"], np.abs(np.sin(q[:, 4])), atol=1e-6)
    # Upper arm (along x of link 2) and forearm (along y of link 3) are in line at 2 pi - pi / 2 - 1.9575.
    stretched = 1.5 * np.pi - 1.9575
    upper, fore, bend = 0.27009, 0.29015, q[:, 2] - stretched
    length = np.sqrt(upper**2 + fore**2 + 2 * upper * fore * np.cos(bend))
    change = np.abs(upper * fore * np.sin(bend) / length)
    np.testing.assert_allclose(measures["elbow"] * gauge.scale["elbow"], change, atol=1e-6)
    wrist_centre = gauge.arm.matrix(q) @ np.array([-0.0865, 0.0, 0.0, 1.0])
    distance = np.linalg.norm(wrist_centre[:, :2], axis=1)
    np.testing.assert_allclose(measures["shoulder"] * gauge.scale["shoulder"], distance, atol=2e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_configurations_are_found_and_lose_rank(gauge, kind):
    rng = np.random.default_rng(2)
    arm = gauge.arm
    start = arm.home + rng.normal(size=(60, 6)) * 0.5
    found = find_singular(gauge, kind, start)
    assert len(found) > 5
    assert np.all((found >= arm.lower) & (found <= arm.upper))
    smallest = np.linalg.svd(weighted(arm.jacobian(found)), compute_uv=False)[:, -1]
    at_home = np.linalg.svd(weighted(arm.jacobian(arm.home[None])), compute_uv=False)[0, -1]
    assert smallest.max() < 0.15 * at_home


def test_an_unknown_kind_is_refused(gauge):
    with pytest.raises(ValueError, match="wrist, elbow, shoulder"):
        find_singular(gauge, "ankle", gauge.arm.home[None])


def test_measures_do_not_depend_on_the_order_of_the_joints():
    names = [f"joint{i}" for i in (3, 1, 2, 6, 4, 5)]
    plain, shuffled = _gauge("airbot_play"), _gauge("airbot_play", joint_names=names)
    q = np.random.default_rng(3).uniform(plain.arm.lower, plain.arm.upper, size=(20, 6))
    permuted = q[:, [int(name[-1]) - 1 for name in names]]
    for kind in KINDS:
        expected = plain(q)[kind] * plain.scale[kind]
        np.testing.assert_allclose(shuffled(permuted)[kind] * shuffled.scale[kind], expected, atol=1e-9)


def test_the_lost_direction_is_what_no_joint_moves(gauge):
    arm = gauge.arm
    singular = find_singular(
        gauge, "shoulder", arm.home + np.random.default_rng(4).normal(size=(40, 6)) * 0.5
    )
    directions = lost_directions(arm, singular)
    units = directions * np.repeat([1.0, ROTATION_LENGTH_M], 3)
    np.testing.assert_allclose(np.linalg.norm(units, axis=1), 1.0, atol=1e-9)
    effect = np.einsum("ni,nij->nj", units, weighted(arm.jacobian(singular)))
    assert np.linalg.norm(effect, axis=1).max() < 0.02


def test_the_lost_direction_does_not_flip_along_a_path(gauge):
    arm = gauge.arm
    target = find_singular(gauge, "wrist", arm.home + np.random.default_rng(5).normal(size=(9, 6)) * 0.3)[0]
    path = arm.home + np.linspace(0, 1, 200)[:, None] * (target - arm.home)
    units = lost_directions(arm, path) * np.repeat([1.0, ROTATION_LENGTH_M], 3)
    assert np.einsum("ni,ni->n", units[1:], units[:-1]).min() > 0.0
