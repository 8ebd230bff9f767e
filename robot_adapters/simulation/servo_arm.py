"""Any serial arm on position servos: MuJoCo dynamics that lag, sag under gravity and are measured with noise.

What a servo does is said by two numbers that one sees on a real arm, from which its gains follow: how long it takes
to follow, and how far it hangs below its command. Needs the `sim` extra.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import why_not_joints
from robot_adapters.simulation.plant import ArmPlant, PlantParameters

Array = NDArray[np.float64]

_TIMESTEP = 0.002  # s
_ARMATURE = 0.005  # kg m^2, the reflected rotor of a geared servo
_MASS, _INERTIA = 0.1, 1e-4  # kg, kg m^2, of a link whose URDF says nothing: a printed bracket with a servo
_POSTURES = 256  # over which the heaviest load of each joint is looked for
_OVERDAMPED = 6.0  # 4 is critical damping: a servo that follows without ringing


@dataclass(frozen=True)
class ServoParameters:
    """How the servos differ from perfect ones.

    Attributes:
        lag: Delay between a moving command and the joint [s].
        sag: How far the most heavily loaded joint posture hangs below its command [rad; m where a joint slides].
        noise: Standard deviation of the measured joints [rad; m where a joint slides].
    """

    lag: float = 0.06
    sag: float = 0.01
    noise: float = 3e-4

    def __post_init__(self) -> None:
        # The arm is simulated until it hangs at rest, for twenty times its lag.
        for name, least, most in (("lag", 0.01, 1.0), ("sag", 1e-4, 0.5), ("noise", 0.0, 0.1)):
            value = getattr(self, name)
            if not least <= value <= most:
                raise ValueError(f"{name}={value}: expected {least:g} to {most:g}")


class ServoArm:
    """An arm's joints on servos, at rest at the start; the same seed and commands give the same motion."""

    def __init__(
        self,
        description: ArmDescription,
        q: ArrayLike | None = None,
        parameters: ServoParameters | None = None,
        seed: int = 0,
    ) -> None:
        """Starts at `q` [rad] (dof,), by default the description's home, else the middle of the ranges.

        Raises:
            ModuleNotFoundError: Without MuJoCo.
            ValueError: A start of another size, or far outside the limits, as degrees are.
        """
        self.parameters = parameters or ServoParameters()
        self.lower, self.upper = _ranges(description)
        start = np.asarray(_posture(description) if q is None else q, dtype=float)
        if start.shape != self.lower.shape or not np.isfinite(start).all():
            raise ValueError(f"start: expected {len(self.lower)} finite joints, got {start.tolist()}")
        reason = why_not_joints(description, start)
        if reason is not None:
            raise ValueError(f"start: {reason}. Expected rad, or m where a joint slides")
        self._random = np.random.default_rng(seed)
        count = len(start)
        plant = PlantParameters(
            torque_factors=(1.0,) * count,
            friction=(0.0,) * count,
            damping=(0.0,) * count,
            armature=(_ARMATURE,) * count,
            lag=(0.0,) * count,
            dead_time=0.0,
            timestep=_TIMESTEP,
        )
        self._plant = ArmPlant(replace(description, urdf=chain_only(description)), plant, start)
        self._kp, self._kd = self._gains()
        self._left = 0.0  # s that are less than a time step
        self.command(start)
        self.advance(20 * self.parameters.lag)  # it hangs on its servos before anybody looks

    @property
    def q(self) -> Array:
        """The true joints [rad] (dof,)."""
        return self._plant.q

    def command(self, q: ArrayLike) -> Array:
        """Send the servos to joints [rad] (dof,), and to the ends of their ranges at most; what was sent."""
        self.target = np.clip(np.asarray(q, dtype=float), self.lower, self.upper)
        for joint, position in enumerate(self.target):
            self._plant.command(joint, float(position), 0.0, 0.0, self._kp[joint], self._kd[joint])
        return self.target.copy()

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        steps, self._left = divmod(self._left + seconds + 1e-9, _TIMESTEP)
        self._plant.step(int(steps))

    def measure(self) -> Array:
        """The joints as the encoders give them [rad] (dof,)."""
        return self.q + self.parameters.noise * self._random.standard_normal(len(self.lower))

    def _gains(self) -> tuple[Array, Array]:
        """Stiffness and damping of each joint [Nm/rad, Nm s/rad]."""
        random = np.random.default_rng(0)
        rest: Array = np.zeros(len(self.lower))
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        loads: Array = rest.copy()
        inertias: Array = rest.copy()
        for _ in range(_POSTURES):
            q = random.uniform(low, high)
            load = self._plant.inverse_dynamics(q, rest, rest)
            loads = np.maximum(loads, np.abs(load))
            # How hard each joint alone is to accelerate; the others only add to it.
            moved = [self._plant.inverse_dynamics(q, rest, unit)[i] for i, unit in enumerate(np.eye(len(q)))]
            inertias = np.maximum(inertias, np.array(moved) - load)
        lag = self.parameters.lag
        stiffness = np.maximum(loads / self.parameters.sag, _OVERDAMPED * inertias / lag**2)
        return stiffness, stiffness * lag


def chain_only(description: ArmDescription) -> str:
    """URDF text of the arm's chain alone, without shapes; links without a mass get one."""
    root = ElementTree.fromstring(description.urdf)
    path = description.chain()
    joints = {joint.name for joint in path}
    links = {path[0].parent, *(joint.child for joint in path)}
    for element in list(root):
        kept = element.get("name") in {"link": links, "joint": joints}.get(element.tag, ())
        if not kept:
            root.remove(element)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
        mass = link.find("inertial/mass")
        if mass is None or not float(mass.get("value", 0)) > 0:
            for old in link.findall("inertial"):
                link.remove(old)
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "mass", value=str(_MASS))
            moments = {
                f"i{a}{b}": str(_INERTIA if a == b else 0.0) for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")
            }
            ElementTree.SubElement(inertial, "inertia", moments)
    extension = ElementTree.SubElement(root, "mujoco")
    # Drawings with moments that no body can have are common.
    ElementTree.SubElement(
        extension, "compiler", balanceinertia="true", boundinertia="1e-6", fusestatic="false"
    )
    return ElementTree.tostring(root, encoding="unicode")


def _ranges(description: ArmDescription) -> tuple[Array, Array]:
    joints = description.joints()
    return np.array([j.lower for j in joints]), np.array([j.upper for j in joints])


def _posture(description: ArmDescription) -> Array:
    """A posture to start in."""
    if description.home:
        return np.array(description.home)
    lower, upper = _ranges(description)
    middle = (np.maximum(lower, -np.pi) + np.minimum(upper, np.pi)) / 2
    return np.clip(middle, lower, upper)
