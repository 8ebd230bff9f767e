"""Scenes: places that the arm reaches, singular configurations of every kind, and any arm with a home."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from lerobot_mimicik.data.teleoperation.hand_motion import sample_style
from lerobot_mimicik.data.teleoperation.scene import ILL_CONDITIONED, Scene
from lerobot_mimicik.data.teleoperation.singularities import KINDS, NEAR
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm


@pytest.fixture(scope="module", params=SHIPPED_ARMS)
def scene(request):
    return Scene.of(describe_arm(request.param), np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(3))
def test_places_are_reached_by_their_joints_and_free(scene, seed):
    rng = np.random.default_rng(seed)
    places = scene.places(sample_style(rng), rng)
    assert len(places.hand) == len(places.joints) >= 16
    np.testing.assert_allclose(places.matrices(places.hand), scene.arm.matrix(places.joints), atol=1e-9)
    assert scene.arm.free(places.joints).all()
    assert np.all((places.joints > scene.arm.lower) & (places.joints < scene.arm.upper))
    measures = scene.gauge(places.joints)
    assert min(measures["elbow"].min(), measures["shoulder"].min()) > NEAR


def test_every_kind_of_singularity_is_known_and_free(scene):
    # Arms of other kinds lack some: a wrist of two joints has no singularity of its own.
    assert set(scene.singular) <= set(KINDS) or set(scene.singular) == {ILL_CONDITIONED}
    assert scene.singular
    if scene.description.urdf.count("airbot_play") or scene.description.urdf.count("piper_sdk"):
        assert tuple(scene.singular) == KINDS
    for kind, q in scene.singular.items():
        assert len(q) >= 10
        if kind in KINDS:
            assert scene.gauge(q)[kind].max() < 0.02
        assert scene.arm.free(q).all()
        assert np.all((q > scene.arm.lower) & (q < scene.arm.upper))


def test_a_scene_is_the_same_in_another_process(scene):
    other = pickle.loads(pickle.dumps(scene))
    rng = np.random.default_rng(1)
    places = [
        each.places(sample_style(np.random.default_rng(5)), np.random.default_rng(6))
        for each in (scene, other)
    ]
    np.testing.assert_array_equal(places[0].joints, places[1].joints)
    q = scene.arm.home + 0.1 * rng.normal(size=(5, len(scene.arm.home)))
    np.testing.assert_array_equal(scene.gauge.nearest(q), other.gauge.nearest(q))


def test_an_arm_with_seven_joints_has_a_scene_too():
    urdf = _seven_joint_arm()
    description = replace(describe_arm(urdf), home=(0.0, 0.6, 0.0, 1.4, 0.0, 0.9, 0.0))
    scene = Scene.of(description, np.random.default_rng(0))
    assert set(scene.singular) >= {"wrist", "elbow"}
    rng = np.random.default_rng(1)
    assert len(scene.places(sample_style(rng), rng).hand) >= 16


def _seven_joint_arm() -> str:
    """Shoulder, elbow and wrist of an anthropomorphic arm: axes z y z y z y z, links of 0.4 m."""
    heights = (0.3, 0.0, 0.4, 0.0, 0.4, 0.0, 0.1)
    parts = ['<robot name="seven"><link name="l0"/>']
    for i, height in enumerate(heights, start=1):
        axis = "0 0 1" if i % 2 else "0 1 0"
        parts.append(
            f'<link name="l{i}"/><joint name="j{i}" type="revolute">'
            f'<parent link="l{i - 1}"/><child link="l{i}"/>'
            f'<origin xyz="0 0 {height}"/><axis xyz="{axis}"/>'
            '<limit lower="-2.8" upper="2.8" effort="1" velocity="3"/></joint>'
        )
    return "".join([*parts, "</robot>"])
