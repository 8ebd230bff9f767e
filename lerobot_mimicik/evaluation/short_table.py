"""The short table of results: the same columns on the screen, on the page and in Markdown.

`report.json` and `report.md` have every column; these ten fit a screen of 100.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

SCREEN_WIDTH = 100
# (key, heading with its unit, what it means, format)
COLUMNS = (
    ("mean_mm", "mean mm", "mean position error of the command", ".3f"),
    ("p95_mm", "P95 mm", "95th percentile of the position error", ".2f"),
    ("max_mm", "max mm", "largest position error", ".1f"),
    (
        "clean_mean_mm",
        "clean mm",
        "mean error against the target without tremor and seams, of stress sets",
        ".2f",
    ),
    ("jerk_rms", "jerk rad/s³", "root mean square of the commands' third difference", ".1f"),
    ("max_dq", "step rad", "largest joint step in a frame", ".3f"),
    ("frozen", "frozen %", "frames in which no joint moved while a reachable target did", ".1f"),
    ("latency_ms_median", "p50 ms", "median duration of one query", ".2f"),
    ("latency_ms_p99", "p99 ms", "99th percentile of the duration of one query", ".2f"),
)
# What stress sets add, where they have it: (key, heading with its unit, what it means, format).
STRESS = (
    (
        "release_step",
        "release rad",
        "largest joint step within 0.5 s of the target's return into reach",
        ".3f",
    ),
    (
        "return_frames",
        "back frames",
        "most frames from a start, return into reach or jump of the target until the command is within 1 mm",
        ".0f",
    ),
    ("late_frames", "late frames", "most of these that a straight way at the largest step saves", ".0f"),
    (
        "seam_jerk",
        "seam jerk",
        "jerk near seams of chunks as a multiple of the motion's own, 95th percentile over seams",
        ".2f",
    ),
    ("excess_percent", "excess %", "pose error out of reach, over the unavoidable one", ".1f"),
    ("lag_ms", "lag ms", "how far the tool is behind the clean target", ".1f"),
    ("depth_mm", "depth mm", "deepest self-collision by the shapes' spheres", ".1f"),
)
FAILED = ("failed", "recordings with a verdict other than Bounded, of all")
_MODES = {"open_loop": "open loop", "closed_loop": "closed loop"}
_LONGEST_NAME = 22


def legend() -> str:
    """What the columns mean."""
    meanings = [(heading, why) for _, heading, why, _ in COLUMNS]
    return "; ".join(f"{heading}: {why}" for heading, why in [*meanings, FAILED]) + "."


def mode_words(mode: str) -> str:
    """A mode as text says it."""
    return _MODES.get(mode, mode.replace("_", " "))


def groups(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, list[Mapping[str, Any]]]]:
    """Title and rows of each dataset in each mode, in the order in which they first appear."""
    for dataset, mode in dict.fromkeys((row["dataset"], row["mode"]) for row in rows):
        members = [row for row in rows if (row["dataset"], row["mode"]) == (dataset, mode)]
        yield f"{dataset}, {mode_words(mode)} ({members[0]['frames']} frames)", members


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row's values as text, the failed recordings last; "-" for what does not apply."""
    found = [row.get(key) for key, *_ in COLUMNS]
    values = [
        "-" if value is None else _shortened(value, form)
        for value, (*_, form) in zip(found, COLUMNS, strict=True)
    ]
    return [*values, failed(row)]


def failed(row: Mapping[str, Any]) -> str:
    """Failed recordings of all, such as "2/20"; "-" in open loop, where nothing can fail."""
    if row.get("verdict") in ("-", None) or "failures" not in row:
        return "-" if row.get("verdict") in ("-", None) else str(row["verdict"])
    return f"{sum(row['failures'].values())}/{row['episodes'] * row.get('seeds', 1)}"


def measured(rows: Sequence[Mapping[str, Any]]) -> tuple[list[Mapping[str, Any]], dict[str, str]]:
    """The rows with results, and the reasons of the solvers that could not be measured, by their name."""
    missing = {str(row["solver"]): str(row["reason"]) for row in rows if row["verdict"] == "unavailable"}
    return [row for row in rows if row["verdict"] != "unavailable"], missing


def screen_table(rows: Sequence[Mapping[str, Any]], unavailable: Mapping[str, str] | None = None) -> str:
    """The table as text of at most `SCREEN_WIDTH` columns, the reasons of missing solvers below it."""
    heads = [heading.rsplit(" ", 1) for _, heading, *_ in COLUMNS]
    top = ["", *(head[0] for head in heads), "failed"]
    units = ["solver", *(head[1] for head in heads), "of"]
    lines: list[str] = []
    for title, members in groups(rows):
        names = [_cut(str(row["solver"]), _LONGEST_NAME) for row in members]
        body = [[name, *cells(row)] for name, row in zip(names, members, strict=True)]
        widths = [max(map(len, column)) for column in zip(top, units, *body, strict=True)]
        lines += ["", _cut(title, SCREEN_WIDTH)]
        for parts in (top, units, *body):
            padded = [
                parts[0].ljust(widths[0]),
                *(p.rjust(w) for p, w in zip(parts[1:], widths[1:], strict=True)),
            ]
            lines.append(_cut("  ".join(padded).rstrip(), SCREEN_WIDTH))
    for name, reason in (unavailable or {}).items():
        lines += ["", *textwrap.wrap(f"{name} is unavailable: {reason.splitlines()[0]}", SCREEN_WIDTH)]
    return "\n".join(lines).lstrip("\n")


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table in Markdown, one for each dataset and mode."""
    head = ["solver", *(heading for _, heading, *_ in COLUMNS), FAILED[0]]
    lines: list[str] = []
    for title, members in groups(rows):
        lines += [
            f"**{title}**",
            "",
            "| " + " | ".join(head) + " |",
            "|---" + "|---:" * (len(head) - 1) + "|",
        ]
        lines += ["| " + " | ".join([str(row["solver"]), *cells(row)]) + " |" for row in members]
        lines.append("")
    return "\n".join(lines)


def stress_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """What stress sets add to the table, a table for each; empty without any, and without columns that none has."""
    lines: list[str] = []
    for title, members in groups(rows):
        if not any(row.get(key) is not None for row in members for key in ("clean_mean_mm", "release_step")):
            continue
        columns = [each for each in STRESS if any(row.get(each[0]) is not None for row in members)]
        lines += [
            f"**{title}**",
            "",
            "| solver | " + " | ".join(heading for _, heading, *_ in columns) + " |",
            "|---" + "|---:" * len(columns) + "|",
        ]
        for row in members:
            found = ["-" if row.get(key) is None else _shortened(row[key], form) for key, *_, form in columns]
            lines.append("| " + " | ".join([str(row["solver"]), *found]) + " |")
        lines.append("")
    return "\n".join(lines)


def stress_legend() -> str:
    """What the columns of `stress_markdown` mean."""
    return "; ".join(f"{heading}: {why}" for _, heading, why, _ in STRESS) + "."


def _shortened(value: float, form: str) -> str:
    """Large numbers lose their decimals: 1234.567 says no more than 1235."""
    return format(
        value, ".0f" if abs(value) >= 1000 else ".1f" if abs(value) >= 100 and form[1] != "0" else form
    )


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 1] + "…"
