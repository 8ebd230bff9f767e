"""The primitive shapes of an arm's links, as its URDF draws them: boxes, cylinders, capsules and spheres.

Meshes are left out. Every shape is placed on the body (see `ArrayChain`) that carries it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import Pose, array_chain, compose_frames, rotation_from_rpy
from lerobot_mimicik.kinematics.urdf import Joint, read_urdf

_BONE, _KNUCKLE = 0.012, 0.02  # radii of what stands for a body without shapes, as fractions of the reach


@dataclass(frozen=True, eq=False)
class Shape:
    """One shape on a body.

    Attributes:
        kind: `box`, `cylinder`, `capsule` or `sphere`.
        size: Its edges x y z; radius and length along z (a capsule's without its caps); its radius [m].
        body: The body that carries it, as `ArrayChain` counts.
        pose: Of the shape in the body's frame.
        colour: Red, green and blue from 0 to 1; None where the URDF names none.
    """

    kind: str
    size: tuple[float, ...]
    body: int
    pose: Pose
    colour: tuple[float, ...] | None = None


def read_shapes(description: ArmDescription, purpose: str = "collision", moving: bool = False) -> list[Shape]:
    """The shapes of the links from base to tip and of what is fixed to them, link by link.

    Args:
        description: The arm.
        purpose: `collision` or `visual`; a link that has none of the visual kind is drawn as it collides.
        moving: Whether links off the chain that joints move (fingers) count too, at the joints' zero.

    Raises:
        ValueError: A size or an origin is not made of finite numbers.
    """
    chain = array_chain(description)
    robot = ElementTree.fromstring(description.urdf)
    links = {link.get("name", ""): link for link in robot.findall("link")}
    colours = {element.get("name", ""): _colour(element, {}) for element in robot.findall("material")}
    beside = _links_beside(description, tuple(chain.links), moving)
    found: list[Shape] = []
    for link, (body, body_link) in chain.links.items():
        for name, link_child in [(link, (np.eye(3), np.zeros(3))), *beside.get(link, [])]:
            at = compose_frames(body_link, link_child)
            shapes = _shapes_of(links[name], purpose, body, at, colours)
            if not shapes and purpose == "visual":
                shapes = _shapes_of(links[name], "collision", body, at, colours)
            found += shapes
    return found


def drawn_shapes(description: ArmDescription) -> list[Shape]:
    """What an arm looks like: its URDF's primitives, and from joint to joint a bone where a body has none."""
    chain = array_chain(description)
    shapes = read_shapes(description, "visual", moving=True)
    reach = chain.stretched_length(0)
    bare = set(range(chain.dof + 1)) - {shape.body for shape in shapes}
    for body in sorted(bare):
        end = (chain.tool if body == chain.dof else chain.steps[body])[1]
        if body:
            shapes.append(Shape("sphere", (_KNUCKLE * reach,), body, (np.eye(3), np.zeros(3))))
        length = float(np.linalg.norm(end))
        if length > 1e-6:
            pose = (_towards(end / length), end / 2)
            shapes.append(Shape("capsule", (_BONE * reach, length), body, pose))
    return shapes


def outline(shape: Shape) -> np.ndarray:
    """Points (n, 3) whose convex hull is the shape, in its body's frame [m]."""
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    if shape.kind == "box":
        points = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T * np.array(shape.size)
    elif shape.kind == "cylinder":
        radius, length = shape.size
        points = np.concatenate([radius * circle + [0, 0, end * length / 2] for end in (-1, 1)])
    else:
        radius = shape.size[0]
        half = shape.size[1] / 2 if shape.kind == "capsule" else 0.0
        rings = np.linspace(-np.pi / 2, np.pi / 2, 7)
        ball = np.concatenate([radius * (np.cos(up) * circle + [0, 0, np.sin(up)]) for up in rings])
        end = np.array([0, 0, half])
        points = np.concatenate([ball + end, ball - end])
    rotation, position = shape.pose
    return points @ rotation.T + position


def _shapes_of(
    link: ElementTree.Element, purpose: str, body: int, at: Pose, colours: dict[str, tuple[float, ...] | None]
) -> list[Shape]:
    found = []
    for element in link.findall(purpose):
        geometry = element.find("geometry")
        if geometry is None or len(geometry) == 0:
            continue
        kind, size = geometry[0].tag, _size(geometry[0])
        if not size or min(size) < 0 or size[0] <= 0:
            continue
        origin = element.find("origin")
        pose = compose_frames(at, _origin(origin)) if origin is not None else at
        found.append(Shape(kind, size, body, pose, _colour(element.find("material"), colours)))
    return found


def _links_beside(
    description: ArmDescription, on_path: tuple[str, ...], moving: bool
) -> dict[str, list[tuple[str, Pose]]]:
    """Links off the chain (a camera, a gripper body) that joints tie to a link of it: T_link_child."""
    below: dict[str, list[Joint]] = {}
    for joint in read_urdf(description.urdf).joints:
        if (moving or joint.type == "fixed") and joint.child not in on_path:
            below.setdefault(joint.parent, []).append(joint)
    found: dict[str, list[tuple[str, Pose]]] = {}
    for link in on_path:
        stack: list[tuple[str, Pose]] = [(link, (np.eye(3), np.zeros(3)))]
        while stack:
            name, pose = stack.pop()
            for joint in below.get(name, []):
                origin = (rotation_from_rpy(joint.origin_rpy), np.array(joint.origin_xyz))
                child = (joint.child, compose_frames(pose, origin))
                found.setdefault(link, []).append(child)
                stack.append(child)
    return found


def _size(geometry: ElementTree.Element) -> tuple[float, ...]:
    """As `Shape.size`; empty for a mesh."""
    if geometry.tag == "box":
        return _numbers(geometry, "size", 3)
    if geometry.tag == "sphere":
        return _numbers(geometry, "radius", 1)
    if geometry.tag in ("cylinder", "capsule"):
        return (*_numbers(geometry, "radius", 1), *_numbers(geometry, "length", 1))
    return ()


def _origin(element: ElementTree.Element) -> Pose:
    roll, pitch, yaw = _numbers(element, "rpy", 3)
    return rotation_from_rpy((roll, pitch, yaw)), np.array(_numbers(element, "xyz", 3))


def _colour(
    material: ElementTree.Element | None, named: dict[str, tuple[float, ...] | None]
) -> tuple[float, ...] | None:
    if material is None:
        return None
    own = material.find("color")
    return named.get(material.get("name", "")) if own is None else _numbers(own, "rgba", 4)[:3]


def _numbers(element: ElementTree.Element, key: str, count: int) -> tuple[float, ...]:
    text = element.get(key, " ".join(["0"] * count))
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"shape of the URDF: {key}={text!r} is not made of {count} finite numbers")
    return values


def _towards(direction: np.ndarray) -> np.ndarray:
    """A rotation that takes z onto a unit direction."""
    return Rotation.align_vectors(direction[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
