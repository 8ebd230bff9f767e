"""Reading URDF: the tree of links and joints, and the serial chain between two of its links.

Only what kinematics needs is read (names, tree, origins, axes, limits); shapes, meshes and inertias are left
alone, so a URDF whose mesh files are missing is as good as one that has them. Nothing here needs torch.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from lerobot_mimicik.kinematics.names import shortened

MOVABLE_TYPES = ("revolute", "continuous", "prismatic")
KNOWN_TYPES = (*MOVABLE_TYPES, "fixed", "floating", "planar")
LONGEST_CHAIN = 256
"""Joints from base to tip, fixed ones included: arms have a dozen or two; a longer chain is a mistake or an attack."""
_BEFORE_XML = "\ufeff \t\r\n"


class UrdfError(ValueError):
    """A URDF that cannot be read, or a question about it that names something it does not have."""


@dataclass(frozen=True)
class Joint:
    """One joint: the pose of its frame in the parent link, and the axis of its motion in that frame.

    At position zero the child link's frame is the joint's frame. Angles in rad, lengths in m.
    """

    name: str
    type: str
    parent: str
    child: str
    origin_xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    origin_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    mimics: str | None = None

    @property
    def movable(self) -> bool:
        """Whether the joint takes a value of its own in the joint vector."""
        return self.type in MOVABLE_TYPES


@dataclass(frozen=True)
class Urdf:
    """A parsed URDF. `joints` are in the order of the file."""

    name: str
    text: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]

    @property
    def root(self) -> str:
        """The link that is no joint's child."""
        children = {joint.child for joint in self.joints}
        return next(link for link in self.links if link not in children)

    @property
    def leaves(self) -> tuple[str, ...]:
        """The links that are no joint's parent."""
        parents = {joint.parent for joint in self.joints}
        return tuple(link for link in self.links if link not in parents)

    def serial_chain(self, base_link: str | None = None, tip_link: str | None = None) -> tuple[Joint, ...]:
        """The joints from `base_link` to `tip_link`, fixed ones included, in that order.

        The base defaults to the root and the tip to the only leaf below the base.

        Raises:
            UrdfError: A link that does not exist, a tip that is not below the base, several leaves and no tip
                given, no movable joint between them, or a joint that a serial arm cannot have (floating,
                planar, mimic).
        """
        base = self.root if base_link is None else self._checked(base_link, "base link")
        tip = self._only_leaf_below(base) if tip_link is None else self._checked(tip_link, "tip link")
        path = self._path(base, tip)
        for joint in path:
            if joint.type in ("floating", "planar"):
                raise UrdfError(
                    f"joint {joint.name!r} between {base!r} and {tip!r} is {joint.type}; a serial arm "
                    f"has only joints of type fixed, {', '.join(MOVABLE_TYPES)}"
                )
            if joint.mimics is not None:
                raise UrdfError(
                    f"joint {joint.name!r} between {base!r} and {tip!r} mimics {joint.mimics!r}; "
                    "coupled joints are not supported in a serial arm"
                )
        if not any(joint.movable for joint in path):
            raise UrdfError(
                f"no movable joint between {base!r} and {tip!r} in URDF {self.name!r}; "
                f"movable joints: {shortened(j.name for j in self.joints if j.movable)}"
            )
        return path

    def _checked(self, link: str, role: str) -> str:
        if link not in self.links:
            raise UrdfError(
                f"{role} {link!r} is not in URDF {self.name!r}; its links: {shortened(self.links)}"
            )
        return link

    def _only_leaf_below(self, base: str) -> str:
        children: dict[str, list[str]] = {}
        for joint in self.joints:
            children.setdefault(joint.parent, []).append(joint.child)
        below, waiting = set(), [base]
        while waiting:
            link = waiting.pop()
            below.add(link)
            waiting.extend(children.get(link, []))
        found = [leaf for leaf in self.leaves if leaf in below]
        if len(found) != 1:
            raise UrdfError(
                f"URDF {self.name!r} has {len(found)} leaf links below {base!r} ({shortened(found)}): "
                "name the tip link"
            )
        return found[0]

    def _path(self, base: str, tip: str) -> tuple[Joint, ...]:
        by_child = {joint.child: joint for joint in self.joints}
        path: list[Joint] = []
        link = tip
        while link != base:
            if link not in by_child:
                above = [tip, *(joint.parent for joint in path)]
                raise UrdfError(
                    f"tip link {tip!r} is not below base link {base!r} in URDF {self.name!r}; "
                    f"links from the tip to the root: {shortened(above)}"
                )
            path.append(by_child[link])
            link = by_child[link].parent
            if len(path) > LONGEST_CHAIN:
                raise UrdfError(
                    f"more than {LONGEST_CHAIN} joints lie between {base!r} and {tip!r} in URDF {self.name!r}; "
                    "name a base link and a tip link with a single arm between them"
                )
        return tuple(reversed(path))


def read_urdf(source: str | Path) -> Urdf:
    """Parse a URDF given as a path or as text (text starts with `<`).

    Raises:
        UrdfError: Not a file, not XML, not a `<robot>`, repeated or missing names, values that are not
            numbers, limits that are missing or in the wrong order, or joints that do not form one tree.
    """
    text = _text_of(source)
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UrdfError(f"URDF {_shown(source)} is not well-formed XML: {error}") from error
    if robot.tag != "robot":
        raise UrdfError(f"URDF {_shown(source)} has the root element <{robot.tag}>, expected <robot>")
    links = tuple(_name_of(element) for element in robot.findall("link"))
    joints = tuple(_joint(element) for element in robot.findall("joint"))
    urdf = Urdf(robot.get("name", "unnamed"), text, links, joints)
    _check_tree(urdf)
    return urdf


def is_urdf_text(source: str | Path) -> bool:
    """Whether `source` is URDF text rather than a path."""
    return isinstance(source, str) and source.lstrip(_BEFORE_XML).startswith("<")


def _text_of(source: str | Path) -> str:
    if is_urdf_text(source):
        # A byte-order mark or blank lines before the XML declaration would make the parser refuse it, and str
        # with an encoding declaration is decoded already.
        return str(source).lstrip(_BEFORE_XML)
    path = Path(source).expanduser()
    if not path.is_file():
        raise UrdfError(f"URDF file {str(path)!r} does not exist")
    try:
        return path.read_text(encoding="utf-8-sig").lstrip()
    except UnicodeDecodeError as error:
        raise UrdfError(f"URDF file {str(path)!r} is not UTF-8 text: {error}") from error


def _shown(source: str | Path) -> str:
    return "text" if is_urdf_text(source) else repr(str(source))


def _name_of(element: ElementTree.Element) -> str:
    name = element.get("name", "").strip()
    if not name:
        raise UrdfError(f"a <{element.tag}> of the URDF has no name")
    return name


def _joint(element: ElementTree.Element) -> Joint:
    name = _name_of(element)
    kind = element.get("type", "")
    if kind not in KNOWN_TYPES:
        raise UrdfError(f"joint {name!r} has type {kind!r}; URDF knows {', '.join(KNOWN_TYPES)}")
    parent, child = (_end_of(element, name, end) for end in ("parent", "child"))
    origin = element.find("origin")
    axis = _triple(element.find("axis"), "xyz", (1.0, 0.0, 0.0), name)
    if kind in MOVABLE_TYPES:  # exporters write the axis 0 0 0 for fixed joints
        axis = _normalised(axis, name)
    lower, upper, velocity = _limits(element.find("limit"), kind, name)
    mimic = element.find("mimic")
    return Joint(
        name=name,
        type=kind,
        parent=parent,
        child=child,
        origin_xyz=_triple(origin, "xyz", (0.0, 0.0, 0.0), name),
        origin_rpy=_triple(origin, "rpy", (0.0, 0.0, 0.0), name),
        axis=axis,
        lower=lower,
        upper=upper,
        velocity=velocity,
        mimics=None if mimic is None else mimic.get("joint", "?"),
    )


def _end_of(element: ElementTree.Element, joint: str, end: str) -> str:
    found = element.find(end)
    link = "" if found is None else found.get("link", "").strip()
    if not link:
        raise UrdfError(f"joint {joint!r} names no {end} link")
    return link


def _triple(
    element: ElementTree.Element | None, key: str, default: tuple[float, float, float], joint: str
) -> tuple[float, float, float]:
    if element is None or key not in element.attrib:
        return default
    words = element.attrib[key].split()
    if len(words) != 3:
        raise UrdfError(f"joint {joint!r}: {element.tag} {key}={element.attrib[key]!r} is not three numbers")
    x, y, z = (_number(word, f"{element.tag} {key}", joint) for word in words)
    return x, y, z


def _number(word: str, what: str, joint: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UrdfError(f"joint {joint!r}: {what} {word!r} is not a finite number")
    return value


def _normalised(axis: tuple[float, float, float], joint: str) -> tuple[float, float, float]:
    length = math.hypot(*axis)
    if length < 1e-9:
        raise UrdfError(f"joint {joint!r} has the axis {axis}, which has no direction")
    x, y, z = (component / length for component in axis)
    return x, y, z


def _limits(element: ElementTree.Element | None, kind: str, joint: str) -> tuple[float, float, float]:
    """Lower, upper and velocity limit; an absent bound is 0, as URDF says, an absent limit infinite."""
    velocity = math.inf
    if element is not None and "velocity" in element.attrib:
        # Exporters that know no speed write 0.
        velocity = _number(element.attrib["velocity"], "limit velocity", joint) or math.inf
    if kind not in ("revolute", "prismatic"):
        return -math.inf, math.inf, velocity
    if element is None:
        raise UrdfError(f"joint {joint!r} is {kind} and has no <limit>")
    lower, upper = (_number(element.get(key, "0"), f"limit {key}", joint) for key in ("lower", "upper"))
    if lower > upper:
        raise UrdfError(f"joint {joint!r}: lower limit {lower} is above upper limit {upper}")
    return lower, upper, velocity


def _check_tree(urdf: Urdf) -> None:
    _check_unique(urdf.links, "link", urdf.name)
    _check_unique((joint.name for joint in urdf.joints), "joint", urdf.name)
    if not urdf.links:
        raise UrdfError(f"URDF {urdf.name!r} has no links")
    known = set(urdf.links)
    parent_of: dict[str, str] = {}
    for joint in urdf.joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in known:
                raise UrdfError(
                    f"joint {joint.name!r} has the {role} link {link!r}, which URDF {urdf.name!r} does "
                    f"not define; its links: {shortened(urdf.links)}"
                )
        if joint.child in parent_of:
            raise UrdfError(f"link {joint.child!r} is the child of several joints of URDF {urdf.name!r}")
        parent_of[joint.child] = joint.parent
    roots = [link for link in urdf.links if link not in parent_of]
    if len(roots) != 1:
        raise UrdfError(f"URDF {urdf.name!r} has {len(roots)} root links ({shortened(roots)}), expected one")
    rooted = set(roots)
    for start in urdf.links:
        path: set[str] = set()
        link = start
        while link not in rooted:
            if link in path:
                raise UrdfError(f"the joints of URDF {urdf.name!r} form a loop through link {link!r}")
            path.add(link)
            link = parent_of[link]
        rooted.update(path)


def _check_unique(names: Iterable[str], kind: str, robot: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise UrdfError(f"URDF {robot!r} defines the {kind} {name!r} twice")
        seen.add(name)
