"""Figures of an evaluation, each with a caption that says in numbers what is to be seen.

Figures are built without pyplot, so no global state and no display is involved.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from scipy.spatial import cKDTree

from lerobot_mimicik.evaluation.evaluate import Evaluation, StudiedSet
from lerobot_mimicik.evaluation.metrics import ESTOP_RAD, JOINT_SPIKE_RAD, Trace
from lerobot_mimicik.evaluation.training_log import Curve
from lerobot_mimicik.evaluation.trajectories import TrajectorySet
from lerobot_mimicik.evaluation.verdict import (
    RETURN_S,
    RETURNED_MM,
    SINGULAR_VALUE,
    Passage,
    returned_after,
)

# Okabe and Ito's colours: told apart by colour-blind readers too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
WIDTH = 4.4  # inches of every figure: at 400 px a point of type is 1.26 px
FONT = 8  # points: legible at that width
_DPI, _PIXELS_PER_INCH = 150, 130
_GREY = "#777777"
_SHADE = "#F0E442"
_MODE_TITLES = {"open_loop": "open loop", "closed_loop": "closed loop"}


@dataclass(frozen=True)
class Plot:
    """A figure, its file name without suffix, its heading and its caption."""

    name: str
    title: str
    figure: Figure
    caption: str

    def save(self, folder: str | Path) -> Path:
        """Write `folder/name.png`; returns its path."""
        path = Path(folder) / f"{self.name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.image()[1])
        return path

    def image(self) -> tuple[str, bytes]:
        """Its media type and its bytes."""
        buffer = io.BytesIO()
        self.figure.savefig(buffer, format="png", dpi=_DPI)
        return "image/png", buffer.getvalue()

    @property
    def width(self) -> int:
        """Pixels that it takes on a page, at most: type of 8 points is as large as the text there."""
        return round(_PIXELS_PER_INCH * self.figure.get_figwidth())


def plot_error_distribution(evaluations: Sequence[Evaluation]) -> Plot:
    """Share of frames with at most a given position error, one panel per mode."""
    modes = _unique(one.row["mode"] for one in evaluations)
    datasets = _unique(one.row["dataset"] for one in evaluations)
    figure = new_figure(0.7 + 1.7 * len(modes) + 0.17 * math.ceil(len(evaluations) / len(modes) / 2))
    panels = np.atleast_1d(figure.subplots(len(modes), 1, sharex=True))
    sentences = []
    solvers = [name for name in _unique(one.row["solver"] for one in evaluations) if name != "hold"]
    styles = {name: ("-", "--", "-.")[number % 3] for number, name in enumerate(solvers)} | {"hold": ":"}
    for panel, mode in zip(panels, modes, strict=True):
        for one in evaluations:
            if one.row["mode"] != mode:
                continue
            error = np.concatenate([trace.position_mm for trace in one.traces])
            held = one.row["solver"] == "hold"
            found = np.sort(error[np.isfinite(error)])
            if found.size:
                panel.plot(
                    np.maximum(found, 1e-3),
                    100 * np.arange(1, found.size + 1) / error.size,
                    color=COLOURS[datasets.index(one.row["dataset"]) % len(COLOURS)],
                    linestyle=styles[one.row["solver"]],
                    label=f"{one.row['solver']}, {one.row['dataset']}",
                )
            if not held:
                sentences.append(
                    f"{one.row['solver']} is within 10 mm on {one.row['sr10']:.1f} % of the frames of "
                    f"{one.row['dataset']} in {mode_title(mode)}, within 1 mm on {one.row['sr1']:.1f} %"
                )
        panel.set(xscale="log", ylabel="frames [%]", title=mode_title(mode))
        panel.set_xlim(0.03, None)
        panel.axvline(RETURNED_MM, color=_GREY, linewidth=0.8)
    panels[-1].set_xlabel("position error at most [mm]")
    legend_below(figure, panels[-1], 2)
    caption = "; ".join(sentences) + ". Dotted: holding still. Grey line: 10 mm." if sentences else ""
    return finished("error_distribution", "Position error over all frames", figure, _sentence(caption))


def plot_closed_loop_error(evaluation: Evaluation) -> Plot:
    """Position error along each trajectory of one evaluation, singular passages shaded (three at most)."""
    recording = evaluation.recording
    order = sorted(range(len(evaluation.traces)), key=lambda i: -len(evaluation.traces[i].position_mm))[:3]
    figure = new_figure(0.6 + 1.3 * len(order))
    panels = np.atleast_1d(figure.subplots(len(order), 1, sharex=True))
    outcomes = [
        returned_after(trace, passage, recording.set.fps)
        for trace, passages in zip(evaluation.traces, recording.passages, strict=True)
        for passage in passages
    ]
    ended = [outcome for outcome in outcomes if outcome is not None]
    for panel, i in zip(panels, order, strict=True):
        trace = evaluation.traces[i]
        seconds = np.arange(len(trace.position_mm)) / recording.set.fps
        for passage in recording.passages[i]:
            panel.axvspan(
                passage.start / recording.set.fps, passage.stop / recording.set.fps, color=_SHADE, alpha=0.5
            )
        panel.plot(seconds, np.maximum(trace.position_mm, 1e-3), color=COLOURS[0], linewidth=0.7)
        panel.axhline(RETURNED_MM, color=_GREY, linewidth=0.8)
        panel.set(yscale="log", ylabel="error [mm]")
        panel.set_title(f"episode {trace.rollout.trajectory.index}", loc="left")
    panels[-1].set_xlabel("time [s]")
    row = evaluation.row
    caption = (
        f"Position error of {row['solver']} in {mode_title(row['mode'])} on {row['dataset']}: every command is "
        f"the next measurement, so errors could pile up. Shaded: {len(outcomes)} passages close to a "
        f"singularity (smallest singular value below {SINGULAR_VALUE:g}); of {len(ended)} that end before "
        f"the recording does, {sum(ended)} are followed by an error under {RETURNED_MM:g} mm within "
        f"{RETURN_S:g} s. Mean {_value(row['mean_mm'], '.2f')} mm, "
        f"largest {_value(row['max_mm'], '.1f')} mm. Verdict: {row['verdict']}"
        + (f" ({row['reason']})." if row["reason"] else ".")
    )
    return finished("closed_loop_error", "Error along near-singular motion", figure, caption)


def strongest_passage(recording: StudiedSet) -> tuple[int, Passage] | None:
    """(trajectory, passage) where the recording comes closest to a singularity, or None without a passage."""
    found = [(i, passage) for i, passages in enumerate(recording.passages) for passage in passages]
    return min(found, key=lambda item: item[1].singular_value) if found else None


def plot_passage(evaluation: Evaluation, joint_names: Sequence[str], margin_s: float = 3.0) -> Plot | None:
    """Joints of recording and solver through the strongest singular passage, or None if there is none."""
    strongest = strongest_passage(evaluation.recording)
    if strongest is None:
        return None
    index, passage = strongest
    trace, fps = evaluation.traces[index], evaluation.recording.set.fps
    margin = round(margin_s * fps)
    # A long passage is shown around its deepest point only.
    start = max(passage.start, passage.deepest - 2 * margin) - margin
    stop = min(passage.stop, passage.deepest + 2 * margin) + margin
    frames = slice(max(start, 0), min(stop, len(trace.position_mm)))
    seconds = (np.arange(frames.start, frames.stop) - passage.deepest) / fps
    recorded, commanded = trace.rollout.trajectory.q[frames], trace.rollout.q_cmd[frames]

    dof = recorded.shape[1]
    columns = 2
    joint_rows = -(-dof // columns)
    figure = new_figure(1.25 * (joint_rows + 1))
    grid = figure.add_gridspec(joint_rows + 1, columns)
    panels = [figure.add_subplot(grid[i // columns, i % columns]) for i in range(dof)]
    for i, panel in enumerate(panels):
        panel.plot(seconds, recorded[:, i], color=_GREY, linewidth=2.4, alpha=0.6, label="recorded")
        panel.plot(seconds, commanded[:, i], color=COLOURS[1], linewidth=1.1, label=evaluation.row["solver"])
        panel.set_title(f"{joint_names[i]} [rad]", loc="left")
    legend_below(figure, panels[0], 2)
    error = figure.add_subplot(grid[joint_rows, :])
    error.plot(seconds, np.maximum(trace.position_mm[frames], 1e-3), color=COLOURS[1], linewidth=1.1)
    error.axhline(RETURNED_MM, color=_GREY, linewidth=0.8)
    error.set(yscale="log", xlabel="time from the closest point [s]", ylabel="error [mm]")
    span = [(frame - passage.deepest) / fps for frame in (passage.start, passage.stop)]
    for panel in [*panels, error]:
        panel.axvspan(max(span[0], seconds[0]), min(span[1], seconds[-1]), color=_SHADE, alpha=0.4)
        panel.set_xlim(seconds[0], seconds[-1])
    return finished(
        "singular_passage",
        "Joint motion through a singularity",
        figure,
        _passage_caption(evaluation, trace, passage, frames),
    )


def plot_training(curves: Mapping[str, Curve]) -> Plot | None:
    """Loss, FK loss, gradient norm and learning rate over training, or None without any of them."""
    wanted = (
        ("loss", "loss", True),
        ("fk_loss", "FK loss", True),
        ("grdn", "gradient norm", True),
        ("lr", "learning rate", False),
    )
    shown = [(name, title, log) for name, title, log in wanted if name in curves]
    if not shown:
        return None
    figure = new_figure(3.8 if len(shown) > 2 else 2.2)
    panels = np.atleast_1d(figure.subplots(-(-len(shown) // 2), min(2, len(shown)))).ravel()
    for panel, (name, title, log) in zip(panels, shown, strict=False):
        panel.plot(curves[name].steps, curves[name].values, color=COLOURS[0], linewidth=1.0, label="training")
        if name == "loss" and "eval_loss" in curves:
            held_out = curves["eval_loss"]
            panel.plot(
                held_out.steps,
                held_out.values,
                "o-",
                color=COLOURS[1],
                markersize=3,
                label="held-out episodes",
            )
            panel.legend()
        panel.set_title(title, loc="left")
        if log and min(curves[name].values) > 0:
            panel.set_yscale("log")
        panel.set_xlabel("step")
    for panel in panels[len(shown) :]:
        panel.remove()
    changes = [
        f"{title} from {curves[name].values[0]:.3g} to {curves[name].values[-1]:.3g}"
        for name, title, _ in shown
    ]
    steps = max(curve.steps[-1] for curve in curves.values())
    held_out_end = (
        f"; on held-out episodes the loss ends at {curves['eval_loss'].values[-1]:.3g}"
        if "eval_loss" in curves
        else ""
    )
    caption = f"{steps} steps: {', '.join(changes)}{held_out_end}."
    return finished("training", "Training curves", figure, caption)


def plot_workspace(train: TrajectorySet, others: Sequence[TrajectorySet]) -> Plot:
    """Where the targets lie, from above and from the side, in the arm's base frame."""
    figure = new_figure(2.7)
    panels = figure.subplots(1, 2)
    rng = np.random.default_rng(0)
    sets = [train, *others]
    positions = {one.name: np.concatenate([t.target[:, :3] for t in one.trajectories]) for one in sets}
    for i, one in enumerate(sets):
        points = positions[one.name]
        points = points[rng.permutation(len(points))[:6000]]
        style = {"s": 1.5, "linewidths": 0, "alpha": 0.35, "color": _GREY if i == 0 else COLOURS[i - 1]}
        panels[0].scatter(points[:, 0], points[:, 1], label=one.name, zorder=-i if i else 0, **style)
        panels[1].scatter(points[:, 0], points[:, 2], zorder=-i if i else 0, **style)
    panels[0].set(xlabel="x [m]", ylabel="y [m]", title="from above", aspect="equal")
    panels[1].set(xlabel="x [m]", ylabel="z [m]", title="from the side", aspect="equal")
    legend_below(figure, panels[0], 3, markerscale=6)
    tree = cKDTree(positions[train.name])
    extent = np.subtract(*np.percentile(positions[train.name], [97.5, 2.5], axis=0))
    sentences = [
        "95 % of the training targets lie in " + " x ".join(f"{size:.2f}" for size in extent) + " m (x, y, z)"
    ]
    for one in others:
        distance = 1e3 * tree.query(positions[one.name])[0]
        sentences.append(
            f"from targets of {one.name} the nearest training target is {np.median(distance):.1f} mm away in "
            f"the median and {np.percentile(distance, 95):.1f} mm at the 95th percentile"
        )
    return finished("workspace", "Workspace coverage", figure, _sentence("; ".join(sentences) + "."))


def _passage_caption(evaluation: Evaluation, trace: Trace, passage: Passage, frames: slice) -> str:
    fps = evaluation.recording.set.fps
    solver, error = evaluation.row["solver"], trace.position_mm[frames]
    recorded_step = np.abs(np.diff(trace.rollout.trajectory.q[frames], axis=0)).max()
    steps = trace.max_dq[frames]
    if not np.isfinite(error).any():
        return f"{solver} had been stopped by a non-finite command before this passage."
    largest = np.nanmax(steps)
    back = np.flatnonzero(trace.position_mm[passage.stop : frames.stop] <= RETURNED_MM)
    if np.nanmax(error) <= RETURNED_MM:
        after = f"the error never leaves {RETURNED_MM:g} mm"
    elif back.size:
        after = f"the error is under {RETURNED_MM:g} mm {back[0] / fps:.1f} s after the passage"
    else:
        after = f"the error is not back under {RETURNED_MM:g} mm in what is shown"
    verdict = (
        "an E-stop"
        if largest > ESTOP_RAD
        else "a joint spike"
        if largest > JOINT_SPIKE_RAD
        else "neither a joint spike nor an E-stop"
    )
    return (
        f"The closest approach to a singularity in {evaluation.recording.set.name}: smallest singular value "
        f"{passage.singular_value:.1e} in episode {trace.rollout.trajectory.index} (shaded: below "
        f"{SINGULAR_VALUE:g}). {solver} is driven by its own commands since the start of the episode, "
        f"{passage.deepest / fps:.0f} s earlier. Its largest joint step here is {largest:.3f} rad per frame "
        f"({verdict}), the recording's {recorded_step:.3f} rad; the largest error is {np.nanmax(error):.1f} "
        f"mm, and {after}."
    )


def new_figure(height: float) -> Figure:
    """An empty figure of this height, inches."""
    return Figure(figsize=(WIDTH, height), layout="constrained")


def legend_below(figure: Figure, panel: Axes, columns: int, **options: Any) -> None:
    """What the lines of a panel are, below the whole figure."""
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(
        handles, labels, fontsize=FONT, loc="outside lower center", ncols=columns, frameon=False, **options
    )


def finished(name: str, title: str, figure: Figure, caption: str) -> Plot:
    """The plot of a figure whose axes get the look of all others."""
    for axes in figure.axes:
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=FONT, which="both")
        for text in axes.findobj(Text):
            text.set_fontsize(FONT)
    return Plot(name, title, figure, caption)


def _unique(values) -> list[str]:
    return list(dict.fromkeys(values))


def mode_title(mode: str) -> str:
    """A mode as text says it."""
    return _MODE_TITLES.get(mode, mode.replace("_", " "))


def _value(number: float | None, form: str) -> str:
    return "-" if number is None else format(number, form)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
