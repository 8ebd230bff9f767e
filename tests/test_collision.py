"""Sphere clearance of an arm."""

import numpy as np
import pytest

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.collision import ArmCollision

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)

_BALLS = """<robot name="balls">
<link name="a"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<link name="b"><collision>
<origin xyz="0.2 0 0"/><geometry><cylinder radius="0.02" length="0.1"/></geometry></collision>
</link>
<link name="c"/>
<link name="hand"><collision><geometry><box size="0.1 0.02 0.02"/></geometry></collision></link>
<joint name="j1" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.4 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3.2" upper="3.2" effort="1" velocity="1"/></joint>
<joint name="grip" type="fixed"><parent link="c"/><child link="hand"/><origin xyz="0.3 0 0"/></joint>
</robot>"""


def test_home_is_clear_and_a_hand_at_the_base_is_not():
    collision = ArmCollision(ARM, HOME, floor=None)
    assert collision.spheres > 10
    folded = np.array([0.0, -2.85, -0.08, 0.72, -1.36, 2.14])
    clearance = collision.clearance(np.stack([HOME, folded]))
    assert clearance[0] > 0.01
    assert clearance[1] < 0


def test_the_floor_counts_when_there_is_one():
    low = np.array([0.0, -2.5, 0.84, *HOME[3:]])
    assert ArmCollision(ARM, HOME).clearance(low[None])[0] < -0.1
    assert ArmCollision(ARM, HOME, floor=None).clearance(low[None])[0] > 0


def test_clearance_is_the_distance_between_shapes():
    """The hand, fixed to the second link, folds back towards the base."""
    collision = ArmCollision(describe_arm(_BALLS, tip_link="c"), np.zeros(2), floor=None)
    stretched, folded = collision.clearance(np.array([[0.0, 0.0], [0.7, np.pi]]))
    assert stretched == pytest.approx(0.7 - 0.05 - 0.05, abs=1e-9)
    assert folded == pytest.approx(0.1 - 0.05 - 0.05, abs=1e-9)


def test_an_arm_without_shapes_never_collides():
    text = ARM.urdf
    while "<collision" in text:
        start = text.index("<collision")
        text = text[:start] + text[text.index("</collision>", start) + len("</collision>") :]
    bare = describe_arm(text, tip_link="end_link")
    collision = ArmCollision(bare, HOME)
    assert collision.spheres == 0
    assert np.isinf(collision.clearance(HOME[None])).all()
