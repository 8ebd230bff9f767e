"""URDF reading: trees are read as written, chains go from base to tip, and faults are named."""

from __future__ import annotations

import math
import sys

import pytest

from lerobot_mimicik.kinematics.urdf import UrdfError, read_urdf

LIMIT = '<limit lower="-1" upper="2" velocity="3" effort="4"/>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", inner: str = LIMIT) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inner}</joint>'
    )


def robot(*joints: str, links: str = "base upper lower hand camera") -> str:
    return (
        "<robot name='r'>"
        + "".join(f'<link name="{link}"/>' for link in links.split())
        + "".join(joints)
        + "</robot>"
    )


TREE = robot(
    joint("mount", "upper", "camera", "fixed", '<axis xyz="0 0 0"/>'),
    joint(
        "shoulder", "base", "upper", inner=LIMIT + '<origin xyz="0 0 0.1" rpy="0 0.5 0"/><axis xyz="0 0 2"/>'
    ),
    joint("elbow", "upper", "lower", "continuous", ""),
    joint("slide", "lower", "hand", "prismatic"),
)


def test_a_chain_is_the_path_from_base_to_tip_whatever_the_order_in_the_file():
    urdf = read_urdf(TREE)
    assert urdf.root == "base"
    assert set(urdf.leaves) == {"hand", "camera"}
    assert [j.name for j in urdf.serial_chain("base", "hand")] == ["shoulder", "elbow", "slide"]
    assert [j.name for j in urdf.serial_chain("lower")] == ["slide"]


def test_values_are_read_and_axes_normalised():
    shoulder, elbow, slide = read_urdf(TREE).serial_chain("base", "hand")
    assert shoulder.origin_xyz == (0.0, 0.0, 0.1)
    assert shoulder.origin_rpy == (0.0, 0.5, 0.0)
    assert shoulder.axis == (0.0, 0.0, 1.0)
    assert (shoulder.lower, shoulder.upper, shoulder.velocity) == (-1.0, 2.0, 3.0)
    assert (elbow.lower, elbow.upper, elbow.velocity) == (-math.inf, math.inf, math.inf)
    assert elbow.axis == (1.0, 0.0, 0.0)
    assert slide.type == "prismatic"


def test_a_path_and_its_text_are_the_same_urdf(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text("\ufeff<?xml version='1.0' encoding='utf-8'?>\n" + TREE, encoding="utf-8")
    from_path = read_urdf(path)
    assert from_path == read_urdf(str(path)) == read_urdf(from_path.text)
    assert from_path.joints == read_urdf("\n " + TREE).joints


@pytest.mark.parametrize(
    ("base", "tip", "expected"),
    [
        ("torso", "hand", r"base link 'torso'.*base, upper, lower, hand, camera"),
        ("base", "gripper", r"tip link 'gripper'.*base, upper, lower, hand, camera"),
        ("base", None, r"2 leaf links below 'base' \((hand, camera|camera, hand)\): name the tip link"),
        ("lower", "camera", r"'camera' is not below base link 'lower'.*camera, upper, base"),
        ("upper", "camera", r"no movable joint between 'upper' and 'camera'.*shoulder, elbow, slide"),
        ("base", "base", r"no movable joint"),
    ],
)
def test_a_chain_that_does_not_exist_is_named_with_what_exists(base, tip, expected):
    with pytest.raises(UrdfError, match=expected):
        read_urdf(TREE).serial_chain(base, tip)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<robot name='r'>", "not well-formed"),
        ("<sdf/>", "root element <sdf>"),
        (robot(), "root links"),
        (robot(links=""), "no links"),
        (robot(joint("j", "base", "hand"), links="base"), "child link 'hand'.*its links: base"),
        (robot(joint("j", "a", "b"), links="a b b"), "link 'b' twice"),
        (robot(joint("j", "a", "b"), joint("j", "b", "c"), links="a b c"), "joint 'j' twice"),
        (robot(joint("j", "a", "b"), joint("k", "c", "b"), links="a b c"), "'b' is the child of several"),
        (robot(joint("j", "b", "c"), joint("k", "c", "b"), links="a b c"), "loop"),
        (robot(joint("j", "a", "b", "hinge"), links="a b"), "type 'hinge'.*revolute"),
        (robot(joint("j", "a", "b", inner=""), links="a b"), "'j' is revolute and has no <limit>"),
        (robot(joint("j", "a", "b", inner='<limit lower="2" upper="1"/>'), links="a b"), "lower limit 2.0"),
        (robot(joint("j", "a", "b", inner=LIMIT + '<axis xyz="0 0 0"/>'), links="a b"), "'j'.*no direction"),
        (robot(joint("j", "a", "b", inner=LIMIT + '<origin xyz="0 1"/>'), links="a b"), "'j'.*three numbers"),
        (robot(joint("j", "a", "b", inner=LIMIT + '<origin xyz="0 1 x"/>'), links="a b"), "'j'.*'x'"),
        (robot(joint("j", "a", "b", inner=LIMIT + '<origin xyz="0 1 nan"/>'), links="a b"), "'j'.*'nan'"),
        (
            "<robot><link name='a'/><joint name='j' type='fixed'><parent link='a'/></joint></robot>",
            "no child link",
        ),
    ],
)
def test_a_faulty_urdf_is_refused_with_the_fault_named(text, expected):
    with pytest.raises(UrdfError, match=expected):
        read_urdf(text)


@pytest.mark.parametrize(
    ("kind", "inner", "expected"),
    [("planar", "", "'j'.*planar"), ("revolute", LIMIT + '<mimic joint="k"/>', "'j'.*mimics 'k'")],
)
def test_joints_that_a_serial_arm_cannot_have_are_refused_in_the_chain_only(kind, inner, expected):
    urdf = read_urdf(robot(joint("j", "a", "b", kind, inner), joint("k", "a", "c"), links="a b c"))
    with pytest.raises(UrdfError, match=expected):
        urdf.serial_chain("a", "b")
    assert [j.name for j in urdf.serial_chain("a", "c")] == ["k"]


def test_a_speed_limit_of_zero_is_none():
    urdf = read_urdf(
        robot(joint("j", "a", "b", inner='<limit lower="-1" upper="1" velocity="0"/>'), links="a b")
    )
    assert urdf.joints[0].velocity == math.inf


def test_a_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "mesh.urdf"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UrdfError, match=r"mesh\.urdf.*not UTF-8"):
        read_urdf(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UrdfError, match=r"nowhere\.urdf"):
        read_urdf(tmp_path / "nowhere.urdf")


def chain_of(count, kind="fixed"):
    joints = [joint(f"j{i}", f"l{i}", f"l{i + 1}", kind, LIMIT) for i in range(count - 1)]
    return robot(*joints, links=" ".join(f"l{i}" for i in range(count)))


def lines_run(count):
    """Lines of the reader that a chain of so many links takes, loops inside expressions not counted."""
    text, lines = chain_of(count), 0

    def trace(frame, event, arg):
        nonlocal lines
        lines += event == "line"
        return trace if frame.f_code.co_filename.endswith("urdf.py") else None

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        read_urdf(text)
    finally:
        sys.settrace(before)
    return lines


def test_reading_takes_time_in_proportion_to_the_links():
    assert lines_run(400) < 2.2 * lines_run(200)


def test_a_chain_of_ten_thousand_joints_is_refused_in_few_words():
    with pytest.raises(UrdfError, match="more than 256 joints lie between 'l0' and 'l9999'"):
        read_urdf(chain_of(10_000, "revolute")).serial_chain()
    with pytest.raises(UrdfError, match=r"its links: l0, .*, and 9980 more") as error:
        read_urdf(chain_of(10_000)).serial_chain(tip_link="nowhere")
    assert len(str(error.value)) < 300
