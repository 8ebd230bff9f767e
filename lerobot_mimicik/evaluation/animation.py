"""The animation of `side_by_side`: both arms, target and tool paths, and below them the joint steps over time.

A GIF, since a page, a README and a model card all show one without a script. The arms are drawn without a renderer:
each shape of the URDF is the convex hull of its projected points, the far ones first.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial import ConvexHull

from lerobot_mimicik import outputs
from lerobot_mimicik.data.arm_arrays import Array
from lerobot_mimicik.evaluation.anatomy import FPS
from lerobot_mimicik.evaluation.metrics import ESTOP_RAD
from lerobot_mimicik.evaluation.side_by_side import Follower, SideBySide
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.shapes import drawn_shapes, outline

_WIDTH, _HEIGHT, _DPI = 4.4, 3.1, 100  # inches: type of 8 points is legible at 400 px
_LARGER = 1.3  # as a page shows it
_FONT = 8
_COLOURS = ("#D55E00", "#009E73")
_BODY, _EDGE = np.array([0.80, 0.83, 0.86]), "#56616b"
_SHADE = 0.35  # how much darker what is far away is
_EVERY = 2  # frames of the motion per frame of the picture
_BEFORE_S, _AFTER_S, _HOLD_S = 2.5, 2.5, 1.0  # shown before and after the singularity; the last frame stays
_PALETTE = 32
_NEARLY_WHITE = 244  # of 255
_ELEVATION = np.radians(18.0)
_SIDE = np.radians(-62.0)  # from where the arm is seen, against the direction that it reaches in
_NEEDLE = 0.17  # of the reach: a hand on a joint that turns much, so that its turning is seen
_NEEDLES = 2


@dataclass(frozen=True)
class Animation:
    """A moving picture, its file name without suffix, its heading and its caption."""

    name: str
    title: str
    caption: str
    data: bytes
    width: int
    """Pixels that it takes on a page, at most."""

    def save(self, folder: str | Path) -> Path:
        """Write `folder/name.gif`; returns its path."""
        path = Path(folder) / f"{self.name}.gif"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.data)
        return path

    def image(self) -> tuple[str, bytes]:
        """Its media type and its bytes."""
        return "image/gif", self.data


def animate(shown: SideBySide, frames: int | None = None) -> Animation:
    """Draw both followers; `frames` takes only so many."""
    begin = max(0, shown.worst - round(_BEFORE_S * FPS))
    numbers = list(range(begin, min(len(shown.target), shown.worst + round(_AFTER_S * FPS)), _EVERY))[:frames]
    figure = Figure(figsize=(_WIDTH, _HEIGHT), dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2,
        2,
        height_ratios=[1.5, 1],
        left=0.115,
        right=0.985,
        top=0.93,
        bottom=0.135,
        wspace=0.02,
        hspace=0.22,
    )
    camera = _Camera(shown)
    stages = [
        _Stage(figure.add_subplot(grid[0, column]), camera, shown, follower, colour)
        for column, (follower, colour) in enumerate(zip(shown.followers, _COLOURS, strict=True))
    ]
    curves = _Curves(figure.add_subplot(grid[1, :]), shown, numbers)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    pictures = []
    for number in numbers:
        canvas.restore_region(background)
        for stage in stages:
            stage.draw(number)
        curves.draw(number)
        # A copy: the canvas goes on to the next frame.
        pictures.append(Image.fromarray(np.array(canvas.buffer_rgba())[..., :3]))
    palette = pictures[len(pictures) // 2].quantize(_PALETTE)
    # The paper is white, not the mean of what is nearly so.
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) > _NEARLY_WHITE] = 255
    palette.putpalette(colours.ravel().tolist())
    pictures = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    file = io.BytesIO()
    step_ms = round(1e3 * _EVERY / FPS)
    durations = [step_ms] * (len(pictures) - 1) + [round(1e3 * _HOLD_S)]
    pictures[0].save(
        file,
        "GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=durations,
        loop=0,
        optimize=True,
        comment=outputs.PICTURE_MARK,
    )
    title = f"Through the {shown.kind} singularity"
    caption = (
        f"{shown.sentence()} Grey: the target's path; coloured: the tool's. The needles turn with the two joints that jump "
        "most. Below: the largest joint step of each frame. In real time."
    )
    return Animation("singularity", title, caption, file.getvalue(), round(_LARGER * _WIDTH * _DPI))


class _Camera:
    """An orthographic look at the arm from the side, a little from above; what all of it fills."""

    def __init__(self, shown: SideBySide) -> None:
        ahead = shown.target[:, :2].mean(axis=0)
        azimuth = np.arctan2(ahead[1], ahead[0]) + _SIDE
        back = np.array(
            [np.cos(_ELEVATION) * np.cos(azimuth), np.cos(_ELEVATION) * np.sin(azimuth), np.sin(_ELEVATION)]
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        self._axes = np.stack([right, np.cross(back, right), back])

    def __call__(self, points: Array) -> Array:
        """Right, up and towards the viewer (n, 3) of points (n, 3) [m]."""
        return points @ self._axes.T


class _Stage:
    """One follower's arm."""

    def __init__(self, axes, camera: _Camera, shown: SideBySide, follower: Follower, colour: str) -> None:
        self._axes, self._camera, self._follower = axes, camera, follower
        chain = array_chain(shown.arm)
        shapes = drawn_shapes(shown.arm)
        self._owner = np.array([shape.body for shape in shapes])
        reach = chain.stretched_length(0)
        beside = shown.followers[0].q
        turning = np.argsort(-np.abs(np.diff(beside, axis=0)).max(axis=0))[:_NEEDLES]
        self._hands = [body for body, column in enumerate(chain.columns, 1) if column in turning]
        needle = _NEEDLE * reach * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        outlines = [outline(shape) for shape in shapes]
        ends = np.cumsum([len(points) for points in outlines])
        self._slices = [slice(end - len(points), end) for end, points in zip(ends, outlines, strict=True)]
        points = [
            np.concatenate(
                [
                    needle,
                    *(points for points, shape in zip(outlines, shapes, strict=True) if shape.body == body),
                ]
            )
            for body in range(chain.dof + 1)
        ]
        moved = [each.transpose(2, 0, 1) for each in chain.body_points(follower.q, points)]
        self._needles = [moved[body][:, :2] for body in self._hands]
        order = np.argsort(self._owner, kind="stable")
        joined = np.concatenate([each[:, 2:] for each in moved], axis=1)
        # Back from body by body to shape by shape.
        sizes = [len(outlines[i]) for i in order]
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        self._parts = [joined[:, s : s + n] for s, n in zip(starts, sizes, strict=True)]
        # Each part keeps its grey: one that changes from frame to frame makes a large file.
        depth = np.array([camera(part[0])[:, 2].mean() for part in self._parts])
        near = (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
        self._greys = _BODY * (1 - _SHADE * (1 - near[:, None]))
        path, seen = camera(shown.target[:, :3]), camera(np.concatenate(self._parts, axis=1).reshape(-1, 3))
        axes.plot(path[:, 0], path[:, 1], color="0.62", lw=2.5, zorder=0)
        self._arm = axes.add_collection(PolyCollection([], linewidths=0.7, edgecolors=_EDGE, animated=True))
        (self._trace,) = axes.plot([], [], color=colour, lw=1.4, animated=True)
        hand = {"color": colour, "lw": 2.4, "ms": 4, "markevery": [1], "animated": True, "clip_on": False}
        self._hand_lines = [axes.plot([], [], "-o", **hand)[0] for _ in self._hands]
        (self._goal,) = axes.plot([], [], "o", color="black", ms=4, animated=True)
        self._text = axes.text(
            0.5,
            -0.02,
            "",
            transform=axes.transAxes,
            fontsize=_FONT,
            color=colour,
            animated=True,
            ha="center",
            va="top",
        )
        axes.set_title(follower.name, fontsize=_FONT + 2, color=colour, pad=2, fontweight="bold")
        low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.margins(0.02)
        axes.set_axis_off()

    def draw(self, number: int) -> None:
        """Frame `number` of the motion: the arm at its command."""
        now = number + 1
        seen = [self._camera(part[now]) for part in self._parts]
        depth = np.array([part[:, 2].mean() for part in seen])
        order = np.argsort(depth)
        self._arm.set_verts([part[ConvexHull(part[:, :2]).vertices, :2] for part in (seen[i] for i in order)])
        self._arm.set_facecolor(self._greys[order])
        for line, ends in zip(self._hand_lines, self._needles, strict=True):
            line.set_data(*self._camera(ends[now])[:, :2].T)
        trace = self._camera(self._follower.tool[: now + 1])
        self._trace.set_data(trace[:, 0], trace[:, 1])
        self._goal.set_data(trace[-1:, 0], trace[-1:, 1])
        self._text.set_text(f"largest step {self._follower.steps[:now].max():.2f} rad")
        for part in (self._arm, self._trace, *self._hand_lines, self._goal, self._text):
            self._axes.draw_artist(part)


class _Curves:
    """Joint steps over time."""

    def __init__(self, axes, shown: SideBySide, numbers: list[int]) -> None:
        self._axes, self._shown = axes, shown
        self._seconds = (np.arange(len(shown.target)) - shown.worst) / FPS
        self._lines = [axes.semilogy([], [], color=colour, lw=1.2, animated=True)[0] for colour in _COLOURS]
        largest = max(float(one.steps.max()) for one in shown.followers)
        axes.axhline(ESTOP_RAD, color="0.5", lw=0.9, ls="--")
        axes.text(
            self._seconds[numbers[0]],
            1.15 * ESTOP_RAD,
            " an arm stops",
            fontsize=_FONT - 1,
            color="0.35",
            va="bottom",
        )
        axes.set(xlim=self._seconds[[numbers[0], numbers[-1]]], ylim=(2e-3, max(3.0, 1.5 * largest)))
        axes.set_xlabel("time from the singularity [s]", fontsize=_FONT, labelpad=1)
        axes.set_ylabel("joint step [rad]", fontsize=_FONT, labelpad=1)
        axes.tick_params(labelsize=_FONT, pad=1)
        axes.minorticks_off()
        axes.spines[["top", "right"]].set_visible(False)

    def draw(self, number: int) -> None:
        """The steps up to frame `number`."""
        for line, follower in zip(self._lines, self._shown.followers, strict=True):
            line.set_data(self._seconds[: number + 1], np.maximum(follower.steps[: number + 1], 1e-4))
            self._axes.draw_artist(line)
