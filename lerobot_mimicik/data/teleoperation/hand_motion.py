"""How a human hand moves a teleoperated tool: operator style, submovements, pauses, corrections and tremor.

A hand pose is six numbers: the position in the arm's base frame (m) and the rotation vector of
R R_pref^T (rad), where R_pref is the session's preferred tool orientation; angles stay far from pi, so the
six numbers may be added. A movement is a sum of minimum-jerk submovements (Flash and Hogan 1985), which may
overlap: an overshoot and its correction are simply two more of them.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_mimicik.data.arm_arrays import Array

TREMOR_BAND_HZ = (3.0, 9.0)
_REACTION_S = 0.12  # the constant part of a reach's duration, whatever its length
_PEAK_TO_MEAN = 1.875  # of a minimum-jerk speed profile
_ROTATION_LENGTH_M = 0.18  # a turn of 1 rad is as much of a movement as a reach of this length
_TURN_RAD_PER_M = 5.0  # turning speed over reaching speed of the same operator


@dataclass(frozen=True)
class OperatorStyle:
    """What stays the same within a session: the person at the leader arm, and the place they work in."""

    reach_speed: float  # m/s, peak of a typical reach
    speed_spread: float  # log-standard deviation of reach speeds
    smoothing_s: float  # standard deviation of the low-pass that hand and leader arm amount to
    curvature: float  # sideways bow of a reach, as a fraction of its length
    overshoot: float  # typical landing error of a reach's first submovement, as a fraction of its length
    correction_rate: float  # fraction of reaches that need corrections
    pause_rate: float  # fraction of arrivals followed by a pause
    pause_s: float  # mean length of a pause
    sway_m: float  # slow wandering of a hand that nothing supports, root mean square per axis
    sway_rad: float  # the same in rotation
    tremor_hz: float  # centre of the tremor's spectrum, within TREMOR_BAND_HZ
    tremor_m: float  # root mean square per axis
    tremor_rad: float  # root mean square per axis
    centre: tuple[float, float, float]  # preferred place, as shares (-0.5..0.5) of the workspace's extent
    extent: tuple[float, float, float]  # fraction of the workspace in use, per axis
    tilt: tuple[float, float, float]  # rotation vector from home to preferred orientation, rad
    tilt_spread: float  # standard deviation of orientations about the preferred one, rad per axis


def sample_style(rng: np.random.Generator) -> OperatorStyle:
    """Draws the style of one session."""
    extent = rng.uniform(0.6, 1.0, size=3)
    centre = rng.uniform(-0.5, 0.5, size=3) * (1 - extent)
    tilt = rng.normal(0.0, [0.25, 0.6, 0.4])
    return OperatorStyle(
        reach_speed=float(np.clip(rng.lognormal(np.log(0.29), 0.25), 0.15, 0.5)),
        speed_spread=float(rng.uniform(0.15, 0.35)),
        smoothing_s=float(rng.uniform(0.03, 0.08)),
        curvature=float(rng.uniform(0.01, 0.10)),
        overshoot=float(rng.uniform(0.02, 0.09)),
        correction_rate=float(rng.uniform(0.2, 0.8)),
        pause_rate=float(rng.uniform(0.05, 0.3)),
        pause_s=float(rng.uniform(0.1, 0.5)),
        sway_m=float(rng.uniform(0.003, 0.009)),
        sway_rad=float(rng.uniform(0.015, 0.05)),
        tremor_hz=float(rng.uniform(4.0, 8.0)),
        tremor_m=float(np.clip(rng.lognormal(np.log(2.5e-4), 0.5), 5e-5, 8e-4)),
        tremor_rad=float(np.clip(rng.lognormal(np.log(1.2e-3), 0.5), 2e-4, 4e-3)),
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        extent=(float(extent[0]), float(extent[1]), float(extent[2])),
        tilt=(float(tilt[0]), float(tilt[1]), float(tilt[2])),
        tilt_spread=float(rng.uniform(0.15, 0.35)),
    )


@dataclass(frozen=True)
class Goal:
    """A pose (6,) to reach, the pace relative to the operator's own, and the least rest on arrival (s)."""

    pose: Array
    pace: float = 1.0
    rest_s: float = 0.0


class HandPath:
    """Builds a hand path by adding submovements; `sample` reads it at any times."""

    def __init__(self, start: Array, style: OperatorStyle, rng: np.random.Generator, begin_s: float = 0.0):
        self.style = style
        self.rng = rng
        self.start = np.asarray(start, dtype=float)
        self.here = self.start.copy()
        self.now = begin_s
        self._onset: list[float] = []
        self._duration: list[float] = []
        self._delta: list[Array] = []
        self._bow: list[Array] = []

    def rest(self, seconds: float) -> None:
        """Holds the hand still for `seconds`."""
        self.now += seconds

    def settle(self, seconds: float) -> None:
        """Waits for the end of all movements and holds still for `seconds`."""
        ends = [onset + duration for onset, duration in zip(self._onset, self._duration, strict=True)]
        self.now = max([self.now, *ends]) + seconds

    def move(self, goal: Goal) -> None:
        """Adds the reach to `goal`: main submovement, perhaps corrections, perhaps a pause."""
        rng, style = self.rng, self.style
        way = goal.pose - self.here
        length = _length(way)
        if length > 1e-6:
            duration = self._reach_s(way, goal.pace)
            corrected = length > 0.01 and rng.random() < style.correction_rate
            error = _landing_error(way, style.overshoot, rng) if corrected else np.zeros(6)
            self._add(self.now, duration, way + error, _bow(way, style.curvature, rng))
            # A correction starts before the reach has ended; a careful operator needs a second one.
            self.now += duration
            for share in (rng.uniform(0.7, 1.0), 1.0):
                if _length(error) < 2e-4:
                    break
                step = -share * error
                correction_s = rng.uniform(0.3, 0.55)
                self.now -= 0.25 * correction_s
                self._add(self.now, correction_s, step, np.zeros(6))
                self.now += correction_s
                error = error + step
        self.here = goal.pose.copy()
        if goal.rest_s > 0 or rng.random() < style.pause_rate:
            self.rest(goal.rest_s + rng.exponential(style.pause_s))
        else:
            # Without a pause the next reach blends into this one, as in one fluent movement.
            self.now -= rng.uniform(0.0, 0.2) * (self._duration[-1] if self._duration else 0.0)

    def sample(self, times: Array) -> Array:
        """Hand poses (n, 6) at `times` (n,), in s."""
        if not self._onset:
            return np.tile(self.start, (len(times), 1))
        phase = np.clip((times[:, None] - np.array(self._onset)) / np.array(self._duration), 0.0, 1.0)
        advance = phase**3 * (10 - 15 * phase + 6 * phase**2)
        bump = 16 * phase**2 * (1 - phase) ** 2
        return self.start + advance @ np.array(self._delta) + bump @ np.array(self._bow)

    def _reach_s(self, way: Array, pace: float) -> float:
        speed = self.style.reach_speed * pace * np.exp(self.rng.normal(0.0, self.style.speed_spread))
        distance, angle = np.linalg.norm(way[:3]), np.linalg.norm(way[3:])
        # Long reaches are faster than short ones, as in Fitts' law; a turn that takes longer sets the time.
        reach = distance / (speed * np.clip(np.sqrt(distance / 0.15), 0.5, 1.25))
        turn = angle / (_TURN_RAD_PER_M * speed)
        return float(_REACTION_S + _PEAK_TO_MEAN * max(reach, turn))

    def _add(self, onset: float, duration: float, delta: Array, bow: Array) -> None:
        self._onset.append(onset)
        self._duration.append(duration)
        self._delta.append(delta)
        self._bow.append(bow)


def tremor(style: OperatorStyle, frames: int, fps: float, rng: np.random.Generator) -> Array:
    """Physiological tremor (frames, 6): m in the first three columns, rad in the last three.

    Noise with a bell-shaped spectrum about the operator's frequency and nothing outside TREMOR_BAND_HZ; its
    strength waxes and wanes over some seconds.
    """
    frequency = np.fft.rfftfreq(frames, 1 / fps)
    low, high = TREMOR_BAND_HZ
    shape = np.exp(-0.5 * ((frequency - style.tremor_hz) / 0.8) ** 2)
    shape[(frequency < low) | (frequency > min(high, 0.49 * fps))] = 0.0
    real, imaginary = rng.normal(size=(2, len(frequency), 6))
    spectrum = shape[:, None] * (real + 1j * imaginary)
    wave = np.fft.irfft(spectrum, n=frames, axis=0)
    rms = np.sqrt(np.mean(wave**2, axis=0))
    wave = np.divide(wave, rms, out=np.zeros_like(wave), where=rms > 0)
    seconds = np.arange(frames) / fps
    swell = 1.0 + 0.4 * np.sin(2 * np.pi * (seconds * rng.uniform(0.1, 0.3) + rng.random()))
    scale = np.repeat([style.tremor_m, style.tremor_rad], 3)
    return wave * swell[:, None] * scale


def sway(style: OperatorStyle, frames: int, fps: float, rng: np.random.Generator) -> Array:
    """Slow wandering of the hand (frames, 6): m in the first three columns, rad in the last three."""
    return slow_wave((frames, 6), fps, rng) * np.repeat([style.sway_m, style.sway_rad], 3)


def slow_wave(shape: tuple[int, int], fps: float, rng: np.random.Generator) -> Array:
    """Smooth random motion (frames, columns) of unit root mean square: sines between 0.05 and 0.4 Hz."""
    frames, columns = shape
    seconds = np.arange(frames)[:, None, None] / fps
    frequency = rng.uniform(0.05, 0.4, size=(3, columns))
    phase = rng.uniform(0.0, 2 * np.pi, size=(3, columns))
    return np.sqrt(2 / 3) * np.sin(2 * np.pi * frequency * seconds + phase).sum(axis=1)


def _length(way: Array) -> float:
    """Length in m that a movement (6,) counts as, rotation included."""
    return float(np.hypot(np.linalg.norm(way[:3]), _ROTATION_LENGTH_M * np.linalg.norm(way[3:])))


def _landing_error(way: Array, share: float, rng: np.random.Generator) -> Array:
    """Over- or undershoot along the way and a smaller miss beside it."""
    along = way * rng.normal(0.3, 1.0) * share
    sizes = np.repeat([np.linalg.norm(way[:3]), np.linalg.norm(way[3:])], 3)
    return along + rng.normal(size=6) * 0.3 * share * sizes


def _bow(way: Array, share: float, rng: np.random.Generator) -> Array:
    """Sideways displacement (6,) at the middle of a reach, perpendicular to its translation."""
    bow = np.zeros(6)
    length = np.linalg.norm(way[:3])
    if length < 1e-4:
        return bow
    # Hands rise in transport rather than sink: the bow leans upwards.
    side = rng.normal(size=3) + np.array([0.0, 0.0, 0.7])
    side -= way[:3] * (side @ way[:3]) / length**2
    bow[:3] = side / max(float(np.linalg.norm(side)), 1e-9) * share * length * rng.uniform(0.2, 1.0)
    return bow
