"""Motion through singularities: smooth, into them and out again, with a hand that strays only there."""

import numpy as np
import pytest

from lerobot_mimicik.data.teleoperation.hand_motion import sample_style
from lerobot_mimicik.data.teleoperation.hand_tracking import ROTATION_LENGTH_M
from lerobot_mimicik.data.teleoperation.scene import Scene
from lerobot_mimicik.data.teleoperation.singular_motion import JointPath, leg, recovery, strayed_hand
from lerobot_mimicik.data.teleoperation.singularities import KINDS, NEAR
from lerobot_mimicik.kinematics.arms import describe_arm

FPS = 20


@pytest.fixture(scope="module")
def scene():
    return Scene.of(describe_arm("airbot_play"), np.random.default_rng(0))


@pytest.fixture(scope="module")
def regular(scene):
    rng = np.random.default_rng(1)
    return scene.places(sample_style(rng), rng).joints


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_a_passage_goes_from_rest_into_the_singularity_and_out_to_rest(scene, regular, kind, seed):
    motion = leg(regular[0], regular, scene.singular[kind], np.random.default_rng(seed), FPS)
    measure = scene.gauge(motion)[kind]
    assert measure.min() < NEAR
    assert np.abs(motion[-1] - regular).max(axis=1).min() < 1e-9
    np.testing.assert_allclose(motion[0], regular[0], atol=1e-9)
    assert np.abs(np.diff(motion, axis=0)).max() < 0.1
    # Human-like joint motion has no corners: acceleration stays far below what a sudden start would give.
    assert np.abs(np.diff(motion, 2, axis=0)).max() < 0.02


def test_a_recovery_lasts_as_long_as_asked(scene, regular):
    motion = recovery(regular, scene.singular["wrist"], np.random.default_rng(0), FPS, 8.0)
    assert len(motion) >= 8.0 * FPS
    assert np.abs(np.diff(motion, axis=0)).max() < 0.1


def test_the_hand_strays_only_near_singularities_and_little(scene, regular):
    motion = np.concatenate(
        [leg(regular[0], regular, scene.singular[k], np.random.default_rng(2), FPS) for k in KINDS]
    )
    stray = strayed_hand(scene.gauge, motion, np.random.default_rng(3), FPS, 4e-3)
    size = np.linalg.norm(stray * np.repeat([1.0, ROTATION_LENGTH_M], 3), axis=1)
    far = scene.gauge.nearest(motion) > NEAR
    assert far.any()
    assert np.all(size[far] == 0.0)
    assert 5e-4 < size.max() <= 4e-3 + 1e-12


def test_a_joint_path_without_movements_is_its_start():
    path = JointPath(np.array([1.0, 2.0]), np.random.default_rng(0))
    path.rest(0.2)
    np.testing.assert_array_equal(path.sample(FPS), np.tile([1.0, 2.0], (5, 1)))
