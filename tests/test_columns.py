"""Finding the arm's joints among a column's elements."""

import pytest

from lerobot_mimicik.columns import flat_names, joint_columns

JOINTS = ["joint1", "joint2", "joint3"]


def test_by_joint_name_whatever_the_separators_and_the_order():
    names = ["gripper.pos", "Joint_2.pos", "joint-1.pos", "joint_3.pos"]
    assert joint_columns("observation.state", names, 4, JOINTS) == [2, 1, 3]


@pytest.mark.parametrize("names", [["a", "b", "c", "d"], None])
def test_the_first_elements_are_taken_only_where_the_user_says_so(names):
    with pytest.raises(
        ValueError, match=r"joints are \['joint1', .*--policy.state_joint_names=\[[0a],[1b],[2c]\]"
    ):
        joint_columns("observation.state", names, 4, JOINTS)
    assert joint_columns("observation.state", names, 4, JOINTS, ["0", "1", "2"]) == [0, 1, 2]
    with pytest.raises(ValueError, match=r"no elements \['4'\]"):
        joint_columns("observation.state", names, 4, JOINTS, ["0", "1", "4"])


def test_requested_names_win():
    names = ["joint1", "joint2", "joint3", "x", "y", "z"]
    assert joint_columns("action", names, 6, JOINTS, ["z", "x", "y"]) == [5, 3, 4]


def test_errors_name_what_is_missing_and_what_exists():
    with pytest.raises(ValueError, match=r"no elements \['w'\]; it has \['x', 'y', 'z'\]"):
        joint_columns("action", ["x", "y", "z"], 3, JOINTS, ["x", "y", "w"])
    with pytest.raises(ValueError, match="2 elements"):
        joint_columns("action", ["x", "y"], 2, JOINTS)
    with pytest.raises(ValueError, match="2 names"):
        joint_columns("action", ["x", "y", "z"], 3, JOINTS, ["x", "y"])


def test_nested_names_are_flattened():
    assert flat_names({"motors": ["a", "b"]}) == ["a", "b"]
    assert flat_names(["a", "b"]) == ["a", "b"]
    assert flat_names(None) is None
