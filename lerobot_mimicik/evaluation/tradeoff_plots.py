"""Accuracy against jerk, every solver a point and every set a panel; failures by kind.

Drawn small on purpose: text is legible when the picture is 400 px wide.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.ticker import MaxNLocator

from lerobot_mimicik.evaluation.plots import COLOURS, FONT, Plot, finished, new_figure
from lerobot_mimicik.evaluation.short_table import groups, mode_words
from lerobot_mimicik.evaluation.verdict import FAILURES
from lerobot_mimicik.evaluation.words import FAILURE_WORDS, count_failures, describe_rows, error_key

_MARKERS = "osD^vP*X<>hd"


def plot_tradeoff(rows: Sequence[Mapping[str, Any]]) -> Plot | None:
    """A point for each solver in each dataset and mode, with its 95 % intervals; None without any number."""
    shown = [row for row in rows if _position(row) is not None]
    if not shown:
        return None
    # Holding still would stretch every axis.
    shown = [row for row in shown if row["solver"] != "hold"] or shown
    panels = list(groups(shown))
    columns = min(2, len(panels))
    lines = math.ceil(len(panels) / columns)
    solvers = list(dict.fromkeys(row["solver"] for row in shown))
    legend_lines = math.ceil(len(solvers) / 3)
    figure = new_figure(0.3 + 1.9 * lines + 0.2 * legend_lines)
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel, (_, members) in zip(grid, panels, strict=False):
        for row in members:
            x, y = _position(row) or (0.0, 0.0)
            number = solvers.index(row["solver"])
            panel.errorbar(
                x,
                y,
                xerr=_bars(row, error_key(row), x),
                yerr=_bars(row, "jerk_rms", y),
                fmt=_MARKERS[number % len(_MARKERS)],
                # Hollow: some recordings failed.
                markerfacecolor="none" if sum(row.get("failures", {}).values()) else None,
                color=COLOURS[number % len(COLOURS)],
                markersize=6,
                elinewidth=0.8,
                label=row["solver"],
            )
        panel.set(xscale="log", yscale="log")
        panel.set_title(f"{members[0]['dataset']}\n{mode_words(members[0]['mode'])}", fontsize=FONT)
        panel.tick_params(labelsize=FONT, which="both")
        panel.minorticks_off()
    for panel in grid[len(panels) :]:
        panel.remove()
    for panel in grid[max(0, len(panels) - columns) : len(panels)]:
        panel.set_xlabel("mean error [mm]", fontsize=FONT)
    figure.supylabel("jerk, RMS [rad/s³]", fontsize=FONT)
    handles: dict[str, Artist] = {}
    for panel in grid[: len(panels)]:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        list(handles.values()),
        list(map(str, handles)),
        fontsize=FONT,
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
    caption = (
        "Down and to the left is better; holding still is left out. Error against the clean target where a set "
        "has one; bars: 95 % intervals over recordings. Hollow: some recordings failed. "
        + " ".join(describe_rows(shown))
    )
    return finished("tradeoff", "Accuracy against jerk", figure, caption)


def plot_failures(rows: Sequence[Mapping[str, Any]]) -> Plot | None:
    """Failed recordings of each solver by kind, over all sets; None where nothing could fail."""
    counts = count_failures(rows)
    if not counts:
        return None
    names = list(counts)
    figure = new_figure(0.9 + 0.24 * len(names))
    panel = figure.subplots()
    begin = [0] * len(names)
    for number, kind in enumerate(FAILURES):
        values = [counts[name][kind] for name in names]
        panel.barh(names, values, left=begin, color=COLOURS[number % len(COLOURS)], label=kind, height=0.7)
        begin = [a + b for a, b in zip(begin, values, strict=True)]
    panel.invert_yaxis()
    panel.tick_params(labelsize=FONT)
    panel.set_xlabel("failed recordings", fontsize=FONT)
    panel.set_xlim(0, max([*begin, 1]))
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(fontsize=FONT, loc="outside lower center", ncols=3, frameon=False)
    kinds = "; ".join(f"{kind}: {why}" for kind, why in FAILURE_WORDS.items())
    total = sum(sum(one.values()) for one in counts.values())
    return finished("failures", "Failures by kind", figure, f"{total} recordings failed in all. {kinds}.")


def _position(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """Error and jerk of a row, above zero for the logarithm; None where one is missing."""
    error, jerk = row.get(error_key(row)), row.get("jerk_rms")
    if error is None or jerk is None:
        return None
    return max(error, 1e-4), max(jerk, 1e-2)


def _bars(row: Mapping[str, Any], key: str, at: float) -> list[list[float]] | None:
    """Distances to both ends of the interval, as matplotlib wants them."""
    interval = row.get("ci95", {}).get(key)
    return None if interval is None else [[max(0.0, at - interval[0])], [max(0.0, interval[1] - at)]]
