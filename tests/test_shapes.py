"""The shapes of an arm's links, and what stands for them where there are none."""

import numpy as np
import pytest

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.shapes import drawn_shapes, read_shapes

_FINGERED = """<robot name="fingered">
<material name="red"><color rgba="1 0 0 1"/></material>
<link name="a"><visual><geometry><capsule radius="0.02" length="0.1"/></geometry><material name="red"/></visual>
<collision><geometry><box size="1 1 1"/></geometry></collision></link>
<link name="b"><visual><geometry><mesh filename="none.stl"/></geometry></visual>
<collision><origin xyz="0 0 0.1"/><geometry><sphere radius="0.03"/></geometry></collision></link>
<link name="finger"><visual><geometry><box size="0.01 0.02 0.03"/></geometry>
<material name=""><color rgba="0 0 1 1"/></material></visual></link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.2"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="grip" type="prismatic"><parent link="b"/><child link="finger"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
</robot>"""


def test_links_are_drawn_as_they_look_or_else_as_they_collide():
    arm = describe_arm(_FINGERED, tip_link="b")
    shapes = read_shapes(arm, "visual", moving=True)
    assert [(s.kind, s.size, s.body) for s in shapes] == [
        ("capsule", (0.02, 0.1), 0),
        ("sphere", (0.03,), 1),
        ("box", (0.01, 0.02, 0.03), 1),
    ]
    assert [s.colour for s in shapes] == [(1, 0, 0), None, (0, 0, 1)]
    assert len(read_shapes(arm)) == 2  # the finger moves by itself: no part of the arm's collisions


def test_a_shape_of_no_size_is_named():
    with pytest.raises(ValueError, match=r"size='1 1'"):
        read_shapes(describe_arm(_FINGERED.replace("1 1 1", "1 1"), tip_link="b"))


def test_bones_join_the_joints_of_an_arm_without_shapes():
    shipped = describe_arm("airbot_play")
    text = shipped.urdf
    for tag in ("visual", "collision"):
        while f"<{tag}>" in text:
            start, end = text.index(f"<{tag}>"), text.index(f"</{tag}>")
            text = text[:start] + text[end + len(tag) + 3 :]
    arm = describe_arm(text, tip_link=shipped.tip_link)
    chain = array_chain(arm)
    ends = [step[1] for step in (*chain.steps, chain.tool)]
    bones = [shape for shape in drawn_shapes(arm) if shape.kind == "capsule"]
    assert len(bones) == sum(np.linalg.norm(end) > 1e-6 for end in ends)
    for bone in bones:
        half = 0.5 * bone.size[1] * bone.pose[0][:, 2]
        np.testing.assert_allclose(bone.pose[1] - half, 0, atol=1e-12)
        np.testing.assert_allclose(bone.pose[1] + half, ends[bone.body], atol=1e-12)
