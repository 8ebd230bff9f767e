"""The bare URDF of an arm that every peer library is given: its chain from base to tool and nothing else.

Libraries differ in how they treat shapes, meshes, links beside the chain, mimicking joints, and bases that
are no root. Written anew from our own reading, an arm is the same to all of them: the root is the
description's base link, the only leaf is its tool frame, tool offset included.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.arms import ArmDescription

BASE = "ik_base"
TOOL = "ik_tool"
# Some libraries give a continuous joint two coordinates. A range of this many rad is as good as none.
_ENDLESS = 1e4


def chain_urdf(description: ArmDescription) -> str:
    """URDF text with the links `BASE`, `ik_link_1` ... and `TOOL`; joints keep their names and limits.

    Continuous joints become revolute ones with limits that are never reached. Masses are fillers that make
    dynamics libraries accept the file.

    Raises:
        UrdfError: The description does not fit its URDF; see `ArmDescription.chain`.
    """
    robot = ElementTree.Element("robot", name="arm")
    parent = _add_link(robot, BASE)
    path = description.chain()
    for number, joint in enumerate(path, 1):
        child = _add_link(robot, f"ik_link_{number}")
        kind = {"fixed": "fixed", "prismatic": "prismatic"}.get(joint.type, "revolute")
        name = joint.name if joint.movable else f"ik_fixed_{number}"
        element = _add_joint(robot, name, kind, parent, child, (*joint.origin_xyz, *joint.origin_rpy))
        if kind != "fixed":
            ElementTree.SubElement(element, "axis", xyz=_text(joint.axis))
            lower, upper = np.clip((joint.lower, joint.upper), -_ENDLESS, _ENDLESS)
            speed = joint.velocity if math.isfinite(joint.velocity) else _ENDLESS
            limits = {"lower": lower, "upper": upper, "velocity": speed, "effort": 1e3}
            ElementTree.SubElement(element, "limit", {key: _text([limits[key]]) for key in limits})
        parent = child
    offset = (*description.tool_offset, *[0.0] * (6 - len(description.tool_offset)))
    _add_joint(robot, "ik_tool_joint", "fixed", parent, _add_link(robot, TOOL), offset)
    return ElementTree.tostring(robot, encoding="unicode")


@contextmanager
def chain_urdf_file(description: ArmDescription) -> Iterator[str]:
    """`chain_urdf` as the path of a file that lives as long as the context."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(chain_urdf(description), encoding="utf-8")
        yield str(path)


def pose_matrix(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Homogeneous transform (4, 4) of a pose (7,), x y z (m) qx qy qz qw."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


def _add_link(robot: ElementTree.Element, name: str) -> str:
    inertial = ElementTree.SubElement(ElementTree.SubElement(robot, "link", name=name), "inertial")
    ElementTree.SubElement(inertial, "mass", value="1")
    inertia = dict.fromkeys(("ixx", "iyy", "izz"), "0.01") | dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    ElementTree.SubElement(inertial, "inertia", inertia)
    return name


def _add_joint(
    robot: ElementTree.Element, name: str, kind: str, parent: str, child: str, origin: tuple[float, ...]
) -> ElementTree.Element:
    element = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    ElementTree.SubElement(element, "origin", xyz=_text(origin[:3]), rpy=_text(origin[3:]))
    return element


def _text(numbers) -> str:
    return " ".join(repr(float(number)) for number in numbers)
