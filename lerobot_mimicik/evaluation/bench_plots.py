"""Figures of a benchmark, drawn from its rows alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_mimicik.evaluation.anatomy import FPS, OUT_OF_REACH, Trial
from lerobot_mimicik.evaluation.bench import LearnedRow
from lerobot_mimicik.evaluation.metrics import ESTOP_RAD, JOINT_SPIKE_RAD, Trace
from lerobot_mimicik.evaluation.plots import (
    COLOURS,
    FONT,
    Plot,
    finished,
    legend_below,
    mode_title,
    new_figure,
)
from lerobot_mimicik.evaluation.verdict import RETURNED_MM

_STYLES = ("-", "--", ":")


def plot_errors(rows: Sequence[Mapping[str, Any]]) -> list[Plot]:
    """Share of frames with at most a given position error: a figure a dataset, a panel a mode."""
    plots = []
    solvers = list(dict.fromkeys(row["solver"] for row in rows))
    for dataset in dict.fromkeys(row["dataset"] for row in rows):
        here = [row for row in rows if row["dataset"] == dataset]
        modes = list(dict.fromkeys(row["mode"] for row in here))
        figure = new_figure(0.7 + 1.8 * len(modes) + 0.17 * math.ceil(len(solvers) / 3))
        panels = np.atleast_1d(figure.subplots(len(modes), 1, sharex=True))
        for panel, mode in zip(panels, modes, strict=True):
            for row in here:
                if row["mode"] != mode:
                    continue
                error = np.array([np.inf if x is None else x for x in row["error_quantiles_mm"]])
                share, number = np.linspace(0, 100, len(error)), solvers.index(row["solver"])
                found = np.isfinite(error)
                panel.plot(
                    np.maximum(error[found], 1e-3),
                    share[found],
                    color=COLOURS[number % len(COLOURS)],
                    linestyle=_STYLES[number // len(COLOURS) % len(_STYLES)],
                    linewidth=1.1,
                    label=row["solver"] if row["seed"] == 0 else None,
                )
            panel.set(xscale="log", ylabel="frames [%]", title=mode_title(mode))
            panel.set_xlim(1e-3, None)
            panel.axvline(RETURNED_MM, color="#777777", linewidth=0.8)
        panels[-1].set_xlabel("position error at most [mm]")
        legend_below(figure, panels[0], 3)
        caption = (
            f"Position error on {dataset}, a line for each seed; a line that ends below 100 % had frames "
            f"without a finite command. Grey line: {RETURNED_MM:g} mm."
        )
        name = f"errors_{dataset.replace('/', '_')}"
        plots.append(finished(name, f"Position error on {dataset}", figure, caption))
    return plots


def plot_fk_weights(rows: Sequence[Mapping[str, Any]], default_weight: float) -> Plot | None:
    """Error of MimicIK over the weight of its FK loss, or None with fewer than three weights.

    Args:
        rows: Of the benchmark, seeds apart.
        default_weight: The weight of the row that is called plain `mimicik`.
    """
    weights: dict[str, float] = {}
    for row in rows:
        learned = LearnedRow.of(row["solver"])
        if learned is not None and learned.base == "mimicik":
            weights[learned.name] = default_weight if learned.fk_weight is None else learned.fk_weight
    if len(set(weights.values())) < 3:
        return None
    ticks = sorted(set(weights.values()))
    figure = new_figure(2.4)
    panels = figure.subplots(1, 2)
    lines = dict.fromkeys((row["dataset"], row["mode"]) for row in rows)
    for panel, (key, title) in zip(
        panels, (("mean_mm", "mean error [mm]"), ("p95_mm", "P95 error [mm]")), strict=True
    ):
        for number, (dataset, mode) in enumerate(lines):
            means = []
            for weight in ticks:
                values = [
                    row[key]
                    for row in rows
                    if weights.get(row["solver"]) == weight
                    and (row["dataset"], row["mode"]) == (dataset, mode)
                    and row[key] is not None
                ]
                means.append(np.mean(values) if values else np.nan)
            label = f"{dataset}, {mode_title(mode)}"
            panel.plot(
                range(len(ticks)),
                means,
                "o-",
                markersize=3,
                color=COLOURS[number % len(COLOURS)],
                label=label,
            )
        panel.set_xticks(range(len(ticks)), [f"{weight:g}" for weight in ticks])
        panel.set(yscale="log", xlabel="weight of the FK loss", ylabel=title)
    legend_below(figure, panels[-1], 2)
    caption = f"Error over the weight of the FK consistency loss, {len(ticks)} weights, means over seeds."
    return finished("fk_weights", "Weight of the FK consistency loss", figure, caption)


def plot_seeds(rows: Sequence[Mapping[str, Any]]) -> Plot | None:
    """Mean error of every training with and without the FK loss, or None without two seeds of both.

    Args:
        rows: Of the benchmark, seeds apart.
    """
    names = ("mimicik", "mimicik_nofk")
    panels_of = list(dict.fromkeys((row["dataset"], row["mode"]) for row in rows if row["solver"] in names))
    values = {
        (place, name): [
            row["mean_mm"]
            for row in rows
            if (row["dataset"], row["mode"]) == place and row["solver"] == name and row["mean_mm"] is not None
        ]
        for place in panels_of
        for name in names
    }
    if not panels_of or min(map(len, values.values())) < 2:
        return None
    lines = math.ceil(len(panels_of) / 2)
    figure = new_figure(0.2 + 2.0 * lines)
    grid = figure.subplots(lines, 2, squeeze=False).ravel()
    panels = grid[: len(panels_of)]
    for panel in grid[len(panels_of) :]:
        panel.remove()
    sentences = []
    for panel, place in zip(panels, panels_of, strict=True):
        spreads = []
        for number, name in enumerate(names):
            found = np.array(values[place, name])
            spreads.append(float(found.std(ddof=1)))
            panel.plot(np.full(len(found), number), found, "o", color=COLOURS[number], markersize=5)
            panel.errorbar(number + 0.2, found.mean(), spreads[-1], fmt="_", color=COLOURS[number], capsize=4)
        panel.set_xticks(range(len(names)), ["with FK loss", "without"])
        panel.set(xlim=(-0.5, 1.6), ylim=(0, None), title=f"{place[0]}\n{mode_title(place[1])}")
        sentences.append(
            f"on {place[0]} in {mode_title(place[1])} the deviation over seeds is {spreads[0]:.3g} mm with and "
            f"{spreads[1]:.3g} mm without the FK loss"
        )
    figure.supylabel("mean error [mm]", fontsize=FONT)
    caption = f"A dot is one training, beside it mean and standard deviation: {'; '.join(sentences)}."
    return finished("fk_seeds", "Spread between seeds with and without the FK loss", figure, caption)


def plot_anatomy(
    trials: Sequence[Trial], traces: Mapping[str, Sequence[Trace]], joint_names: Sequence[str]
) -> list[Plot]:
    """What each solver did in the standard motions: a joint, the joint step and the error, a figure a motion.

    Args:
        trials: The motions.
        traces: Of every solver, in the motions' order.
        joint_names: Of the arm.
    """
    return [
        _plot_trial(trial, {name: found[number] for name, found in traces.items()}, joint_names)
        for number, trial in enumerate(trials)
    ]


def _plot_trial(trial: Trial, traces: Mapping[str, Trace], joint_names: Sequence[str]) -> Plot:
    figure = new_figure(3.8 + 0.17 * math.ceil(len(traces) / 3))
    joint_panel, step_panel, error_panel = panels = figure.subplots(3, 1, sharex=True)
    seconds = (np.arange(len(trial.trajectory)) - trial.worst) / FPS
    # The joint on which the solvers agree least.
    stacked = np.stack([trace.rollout.q_cmd for trace in traces.values()])
    spread = np.nan_to_num(np.nanmax(stacked, axis=0) - np.nanmin(stacked, axis=0)).max(axis=0)
    joint = int(spread.argmax())
    jumped = []
    for index, (name, trace) in enumerate(traces.items()):
        line = {
            "color": COLOURS[index % len(COLOURS)],
            "linestyle": _STYLES[index // len(COLOURS) % len(_STYLES)],
            "linewidth": 1.0,
            "label": name,
        }
        joint_panel.plot(seconds, trace.rollout.q_cmd[:, joint], **line)
        step_panel.plot(seconds, np.maximum(trace.max_dq, 1e-4), **line)
        error_panel.plot(seconds, np.maximum(trace.position_mm, 1e-3), **line)
        largest = np.nanmax(trace.max_dq)
        if largest > JOINT_SPIKE_RAD * (1 + 1e-6):
            jumped.append(f"{name} {largest:.2f} rad")
    joint_panel.set(ylabel=f"{joint_names[joint]} [rad]")
    step_panel.set(yscale="log", ylabel="joint step [rad]")
    for limit in (JOINT_SPIKE_RAD, ESTOP_RAD):
        step_panel.axhline(limit, color="#777777", linewidth=0.8)
    error_panel.set(yscale="log", ylabel="error [mm]", xlabel="time from the worst point [s]")
    error_panel.axhline(RETURNED_MM, color="#777777", linewidth=0.8)
    legend_below(figure, panels[0], 3)
    where = trial.name if trial.name == OUT_OF_REACH else f"through the {trial.name} singularity"
    caption = (
        "Solvers see the poses only, in closed loop. Shown is the joint on which they agree least. Grey lines: 0.1 and "
        f"0.5 rad, 10 mm. {f'Steps over 0.1 rad: {", ".join(jumped)}.' if jumped else 'No step is over 0.1 rad.'}"
    )
    name = f"anatomy_{trial.name.replace(' ', '_')}"
    return finished(name, f"{where[0].upper()}{where[1:]}", figure, caption)
