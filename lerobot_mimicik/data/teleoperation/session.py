"""One recording session of synthetic teleoperation: an operator, their places, their episodes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.data.arm_arrays import Array
from lerobot_mimicik.data.teleoperation.hand_motion import HandPath, OperatorStyle, sample_style, sway, tremor
from lerobot_mimicik.data.teleoperation.hand_tracking import (
    damped_step,
    limit_norm,
    limit_speed,
    smooth,
    track,
)
from lerobot_mimicik.data.teleoperation.operator_tasks import draw_task, perform
from lerobot_mimicik.data.teleoperation.scene import Places, Scene
from lerobot_mimicik.data.teleoperation.sensing import (
    ENCODER_QUANTUM_RAD,
    follow,
    lag_remainder,
    perturb_poses,
    quantise,
    wander,
)
from lerobot_mimicik.data.teleoperation.singular_motion import leg, recovery, strayed_hand
from lerobot_mimicik.data.writer import Episode

RECOVERY_TASK = "Work the arm out of a singularity"
OOD_TASK = "Move through near-singular configurations"

_TREMOR_STEP = 0.05  # tremor's share of the largest joint step, to either side
_TRACKING_STEP = 0.15  # rad per frame while tracking, before the motion is slowed to its limit
_ATTEMPTS = 12


@dataclass(frozen=True)
class SyntheticConfig:
    """How synthetic teleoperation is recorded.

    Attributes:
        fps: Frames per second.
        episode_s: Mean length of an episode [s].
        episodes_per_session: How many episodes an operator records in one go.
        recovery_share: Share of episodes that show how to leave a singularity (the paper: some 400 of 6,427).
        ood_episodes, ood_s: Number and length [s] of the near-singular test trajectories.
        max_step: Bound on the change of a joint command from frame to frame [rad]; with a lag of up to 0.07 s
            (at 20 fps) also on the distance from measured to commanded joints.
        lag_s: Time constant of the follower arm behind its command [s]. At 0.04 s and 20 fps the distance
            from measured to commanded joints is about 1.4 frames of motion.
        quantum: Step of the joint encoders, for state and action [rad].
        sensor_noise, repeatability: Standard deviations of white and of slow joint noise in the state [rad].
        label_offset_m, label_offset_rad: Standard deviation per axis of a session's constant error of both
            pose labels, as left by a calibration.
        label_noise_m, label_noise_rad: The same of each frame.
        stray_m: How far the hand's target may leave the commanded pose near a singularity in recovery
            episodes and near-singular trajectories [m].
        tremor: Factor on the trembling of hands.
    """

    fps: int = 20
    episode_s: float = 13.4
    episodes_per_session: int = 20
    recovery_share: float = 400 / 6427
    ood_episodes: int = 3
    ood_s: float = 415.0
    max_step: float = 0.1
    lag_s: float = 0.04
    quantum: float = ENCODER_QUANTUM_RAD
    sensor_noise: float = 1e-4
    repeatability: float = 2e-4
    label_offset_m: float = 2e-4
    label_offset_rad: float = 5e-4
    label_noise_m: float = 1e-4
    label_noise_rad: float = 3e-4
    stray_m: float = 4e-3
    tremor: float = 1.0

    @classmethod
    def clean(cls, **others: Any) -> "SyntheticConfig":
        """Steady hands and exact sensors: what a hand means to do, and nothing else."""
        noise = (
            "lag_s", "quantum", "sensor_noise", "repeatability", "label_offset_m", "label_offset_rad",
            "label_noise_m", "label_noise_rad", "stray_m", "tremor",
        )  # fmt: skip
        return cls(**(dict.fromkeys(noise, 0.0) | others))

    def __post_init__(self) -> None:
        positive = ("fps", "episode_s", "episodes_per_session", "ood_episodes", "ood_s", "max_step")
        for name in positive:
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in set(self.__dataclass_fields__) - {*positive}:
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if self.recovery_share > 1:
            raise ValueError(f"recovery_share must be between 0 and 1, got {self.recovery_share}")


@dataclass(frozen=True)
class SessionPlan:
    """What one session shall hold.

    Attributes:
        name: Session label.
        seed: Entropy of its random numbers; nothing else decides them.
        regular: Number of everyday episodes.
        recovery: Kinds of singularity, one for each recovery episode.
    """

    name: str
    seed: tuple[int, ...]
    regular: int
    recovery: tuple[str, ...] = ()


def record_sessions(
    scene: Scene, plans: Sequence[SessionPlan], config: SyntheticConfig
) -> list[list[Episode]]:
    """Episodes of each planned session; the sessions are simulated side by side but independently."""
    sessions = [_Session(scene, plan, config) for plan in plans]
    # Everyday motion of all sessions is tracked in one batch; collisions send episodes back for another try.
    for _ in range(_ATTEMPTS):
        drafts = [(session, *draft) for session in sessions for draft in session.drafts()]
        if not drafts:
            break
        starts = np.stack([places for _, _, places, _ in drafts])
        longest = max(len(targets) for *_, targets in drafts)
        padded = np.stack(
            [np.concatenate([t, np.repeat(t[-1:], longest - len(t), axis=0)]) for *_, t in drafts]
        )
        motions = track(scene.arm, starts, padded, _TRACKING_STEP)
        for (session, task, _, targets), motion in zip(drafts, motions, strict=True):
            session.take(task, motion[: len(targets)])
    return [session.finish() for session in sessions]


def record_near_singular(scene: Scene, plan: SessionPlan, config: SyntheticConfig) -> Episode:
    """One long trajectory that visits every kind of singularity the arm has, over and over."""
    session = _Session(scene, plan, config)
    frames = round(config.ood_s * config.fps)
    kinds = list(scene.singular)
    pieces: list[Array] = []
    here = session.places.joints[0]
    while sum(len(piece) for piece in pieces) < frames:
        kind = kinds[len(pieces) % len(kinds)]
        start = here

        def draft(kind: str = kind, start: Array = start) -> Array:
            return leg(start, session.places.joints, scene.singular[kind], session.rng, config.fps)

        pieces.append(session.joint_motion(draft))
        here = pieces[-1][-1]
    motion = np.concatenate(pieces)[:frames]
    return session.episode(OOD_TASK, motion, stray=True)


class _Session:
    def __init__(self, scene: Scene, plan: SessionPlan, config: SyntheticConfig):
        self.scene, self.plan, self.config = scene, plan, config
        self.rng = np.random.default_rng(np.random.SeedSequence(plan.seed))
        self.style: OperatorStyle = sample_style(self.rng)
        self.places: Places = scene.places(self.style, self.rng)
        self.offset = self.rng.normal(size=6) * np.repeat([config.label_offset_m, config.label_offset_rad], 3)
        self._regular: list[Episode] = []

    def drafts(self) -> Iterator[tuple[str, Array, Array]]:
        """Task, first joints (dof,) and hand poses (frames, 4, 4) of the episodes still missing."""
        for _ in range(self.plan.regular - len(self._regular)):
            first = int(self.rng.integers(len(self.places.hand)))
            path = HandPath(self.places.hand[first], self.style, self.rng, begin_s=self.rng.uniform(0.1, 0.6))
            task = draw_task(self.rng)
            # A task ends after a whole movement, some 2 s past the time it is given.
            seconds = max(2.0, self.config.episode_s * self.rng.lognormal(-0.03, 0.25) - 2.2)
            perform(task, path, self.places.hand, seconds)
            times = np.arange(round(path.now * self.config.fps)) / self.config.fps
            hand = path.sample(times) + sway(self.style, len(times), self.config.fps, self.rng)
            yield task, self.places.joints[first], self.places.matrices(hand)

    def take(self, task: str, motion: Array) -> None:
        """Makes an episode of tracked joints (frames, dof), unless they collide or run into a limit.

        Operators keep clear of limits: there the arm would leave the hand behind.
        """
        motion = self._slowed(smooth(motion, self.style.smoothing_s * self.config.fps))
        arm = self.scene.arm
        clear = np.all((motion > arm.lower + 1e-3) & (motion < arm.upper - 1e-3))
        if clear and arm.free(motion).all():
            self._regular.append(self.episode(task, motion, stray=False))

    def finish(self) -> list[Episode]:
        """All episodes, the recovery episodes at random places among the others."""
        if len(self._regular) < self.plan.regular:
            raise ValueError(
                f"session {self.plan.name}: {_ATTEMPTS} attempts gave {len(self._regular)} of "
                f"{self.plan.regular} episodes without collisions and clear of joint limits; the arm's home "
                f"configuration {list(self.scene.description.home)} may be too close to either"
            )
        episodes = list(self._regular)
        for kind in self.plan.recovery:
            at = int(self.rng.integers(len(episodes) + 1))
            episodes.insert(at, self._recovery(kind))
        return episodes

    def _recovery(self, kind: str) -> Episode:
        regular, singular = self.places.joints, self.scene.singular[kind]
        seconds = self.config.episode_s - 5.0

        def draft() -> Array:
            return recovery(regular, singular, self.rng, self.config.fps, seconds)

        return self.episode(RECOVERY_TASK, self.joint_motion(draft), stray=True)

    def joint_motion(self, draft: Callable[[], Array]) -> Array:
        """The first motion (frames, dof) out of `draft` without collisions, slowed to the speed limit."""
        for _ in range(20 * _ATTEMPTS):
            motion = np.clip(self._slowed(draft()), self.scene.arm.lower, self.scene.arm.upper)
            if self.scene.arm.free(motion).all():
                return motion
        raise ValueError(
            f"session {self.plan.name}: found no motion through a singularity that does not collide"
        )

    def episode(self, task: str, motion: Array, stray: bool) -> Episode:
        """Adds tremor to a joint motion (frames, dof) and records it as command, state and pose labels."""
        config, arm, rng = self.config, self.scene.arm, self.rng
        trembling = config.tremor * tremor(self.style, len(motion), config.fps, rng)
        shaking = damped_step(arm.jacobian(motion), trembling)
        command = motion + limit_norm(shaking, _TREMOR_STEP * config.max_step)
        action = quantise(np.clip(command, arm.lower, arm.upper), config.quantum)
        measured = follow(action, config.lag_s, config.fps)
        measured = measured + wander(measured.shape, config.repeatability, 1.0, config.fps, rng)
        measured = measured + rng.normal(size=measured.shape) * config.sensor_noise
        state = quantise(measured, config.quantum)
        target = arm.pose(action)
        if stray:
            target = _displaced(
                target, strayed_hand(self.scene.gauge, motion, rng, config.fps, config.stray_m)
            )
        noise = (config.label_noise_m, config.label_noise_rad)
        return Episode(
            state=state,
            action=action,
            ee_pose=perturb_poses(arm.pose(state), self.offset, *noise, rng),
            ee_target=perturb_poses(target, self.offset, *noise, rng),
            task=task,
            session=self.plan.name,
        )

    def _slowed(self, motion: Array) -> Array:
        config = self.config
        # A follower with a lag is further behind its command than one frame's motion.
        follows = 1.0 - lag_remainder(config.lag_s, config.fps)
        # Tremor, clipped to a share of the step on either side, quantisation and noise come on top.
        noise = 2 * config.quantum + 4 * (config.sensor_noise + config.repeatability)
        return limit_speed(motion, max(follows, 0.5) * ((1 - 2 * _TREMOR_STEP) * config.max_step - noise))


def _displaced(poses: Array, twist: Array) -> Array:
    """Poses (n, 7) moved by `twist` (n, 6: m, rad) in the base frame."""
    turned = Rotation.from_rotvec(twist[:, 3:]) * Rotation.from_quat(poses[:, 3:])
    return np.column_stack([poses[:, :3] + twist[:, :3], turned.as_quat(canonical=True)])
