"""Figures of a benchmark, drawn from its rows alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_mimicik.evaluation.bench import LearnedRow
from lerobot_mimicik.evaluation.plots import COLOURS, Plot, finished, mode_title, new_figure
from lerobot_mimicik.evaluation.verdict import RETURNED_MM

_STYLES = ("-", "--", ":")


def plot_errors(rows: Sequence[Mapping[str, Any]]) -> list[Plot]:
    """Share of frames with at most a given position error: a figure a dataset, a panel a mode."""
    plots = []
    solvers = list(dict.fromkeys(row["solver"] for row in rows))
    for dataset in dict.fromkeys(row["dataset"] for row in rows):
        here = [row for row in rows if row["dataset"] == dataset]
        modes = list(dict.fromkeys(row["mode"] for row in here))
        figure = new_figure(8.6, 3.6)
        panels = np.atleast_1d(figure.subplots(1, len(modes), sharey=True))
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
            panel.set(xscale="log", xlabel="position error [mm]", title=mode_title(mode))
            panel.set_xlim(1e-3, None)
            panel.axvline(RETURNED_MM, color="#777777", linewidth=0.8)
        panels[0].set_ylabel("frames with at most this error [%]")
        panels[-1].legend(fontsize=7)
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
        default_weight: The weight of the row that is called plain ``mimicik``.
    """
    weights: dict[str, float] = {}
    for row in rows:
        learned = LearnedRow.of(row["solver"])
        if learned is not None and learned.base == "mimicik":
            weights[learned.name] = default_weight if learned.fk_weight is None else learned.fk_weight
    if len(set(weights.values())) < 3:
        return None
    ticks = sorted(set(weights.values()))
    figure = new_figure(8.6, 3.2)
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
    panels[-1].legend(fontsize=7)
    caption = f"Error over the weight of the FK consistency loss, {len(ticks)} weights, means over seeds."
    return finished("fk_weights", "Weight of the FK consistency loss", figure, caption)
