"""The report of an evaluation as `report.json` and as a Markdown table."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from lerobot_mimicik import outputs
from lerobot_mimicik.data.writer import ARM_FILE, LOG_FILE
from lerobot_mimicik.evaluation import verdict as verdict_rules
from lerobot_mimicik.evaluation.evaluate import StudiedSet
from lerobot_mimicik.evaluation.metrics import (
    ESTOP_RAD,
    JOINT_SPIKE_RAD,
    LIMIT_TOLERANCE_RAD,
    STEP_TOLERANCE_RAD,
)

ROW_KEYS = (
    "solver", "mode", "dataset", "frames", "mean_mm", "p95_mm", "max_mm", "rot_mean_deg", "sr1", "sr5",
    "sr10", "cartesian_spike", "joint_spike", "estop", "max_dq", "limit_violations", "nonfinite", "jerk",
    "latency_ms_median", "latency_ms_p99", "verdict",
)  # fmt: skip

# (key, heading, format) of the table's columns.
_COLUMNS = (
    ("solver", "solver", "s"),
    ("mode", "mode", "s"),
    ("dataset", "dataset", "s"),
    ("frames", "frames", "d"),
    ("mean_mm", "mean [mm]", ".2f"),
    ("p95_mm", "P95 [mm]", ".2f"),
    ("max_mm", "max [mm]", ".1f"),
    ("rot_mean_deg", "rot. mean [deg]", ".2f"),
    ("rot_p95_deg", "rot. P95 [deg]", ".2f"),
    ("sr1", "SR@1mm [%]", ".1f"),
    ("sr5", "SR@5mm [%]", ".1f"),
    ("sr10", "SR@10mm [%]", ".2f"),
    ("cartesian_spike", "Cartesian spike [%]", ".2f"),
    ("joint_spike", "joint spike [%]", ".2f"),
    ("estop", "E-stop [%]", ".2f"),
    ("max_dq", "max dq [rad]", ".3f"),
    ("limit_violations", "outside limits [%]", ".2f"),
    ("nonfinite", "non-finite", "d"),
    ("jerk", "jerk [rad/frame^3]", ".4f"),
    ("latency_ms_median", "median [ms]", ".2f"),
    ("latency_ms_p99", "p99 [ms]", ".2f"),
    ("energy_mj", "energy [mJ]", ".2f"),
    ("verdict", "verdict", "s"),
)


def machine() -> dict[str, Any]:
    """What the timings were taken on."""
    return {
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "platform": platform.platform(),
    }


def definitions() -> dict[str, Any]:
    """The thresholds behind rates and verdicts."""
    rules = verdict_rules
    return {
        "joint_spike_rad_per_frame": JOINT_SPIKE_RAD,
        "estop_rad_per_frame": ESTOP_RAD,
        "step_tolerance_rad": STEP_TOLERANCE_RAD,
        "limit_tolerance_rad": LIMIT_TOLERANCE_RAD,
        "jerk_unit": "rad/frame^3",
        "singular_value_below": rules.SINGULAR_VALUE,
        "return_window_s": rules.RETURN_S,
        "returned_below_mm": rules.RETURNED_MM,
        "frozen_window_s": rules.FROZEN_S,
        "frozen_below_rad": rules.FROZEN_RAD,
        "growth_factor": rules.GROWTH,
        "lost_above_mm": rules.LOST_MM,
    }


def describe_recording(recording: StudiedSet) -> dict[str, Any]:
    """What a dataset holds, for the report."""
    return {
        "name": recording.set.name,
        "root": str(recording.set.root),
        "fps": recording.set.fps,
        "episodes": len(recording.set.trajectories),
        "frames": recording.set.frames,
        "singular_passages": sum(map(len, recording.passages)),
        # Only datasets that this project made name their arm; unless they were made of a log of joints,
        # these were generated or retargeted.
        "synthetic_labels": (recording.set.root / ARM_FILE).is_file()
        and not (recording.set.root / LOG_FILE).is_file(),
        "smallest_singular_value": float(min(value.min() for value in recording.singular_value)),
    }


def unavailable_row(
    solver: str, reason: str, mode: str | None = None, dataset: str | None = None
) -> dict[str, Any]:
    """The row of a solver that could not be measured: nothing but its name and why."""
    row: dict[str, Any] = dict.fromkeys(ROW_KEYS)
    return row | {
        "solver": solver,
        "mode": mode,
        "dataset": dataset,
        "verdict": "unavailable",
        "reason": reason,
    }


def write_report(
    out: str | Path,
    rows: Sequence[Mapping[str, Any]],
    recordings: Sequence[StudiedSet],
    settings: Mapping[str, Any],
) -> tuple[Path, Path]:
    """Write `report.json` and `report.md` into `out`.

    Args:
        out: Folder; made where it does not exist.
        rows: One mapping per row with at least `ROW_KEYS`; rates in percent.
        recordings: The datasets of the rows.
        settings: What the evaluation was asked to do.

    Returns:
        The two paths.

    Raises:
        FileExistsError: If there are such files that this project did not write, see `outputs`.
        ValueError: If a row lacks a key.
    """
    for row in rows:
        missing = [key for key in ROW_KEYS if key not in row]
        if missing:
            raise ValueError(f"A row of {row.get('solver', 'a solver')} lacks {', '.join(missing)}.")
    out = Path(out)
    outputs.claim(out, "report")
    report = {
        "rows": [_jsonable(row) for row in rows],
        "datasets": [describe_recording(recording) for recording in recordings],
        "settings": dict(settings),
        "machine": machine(),
        "definitions": definitions(),
    }
    json_path, markdown_path = out / "report.json", out / "report.md"
    json_path.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
    markdown_path.write_text(_markdown(report, rows))
    return json_path, markdown_path


def markdown_table(
    rows: Sequence[Mapping[str, Any]], spreads: Sequence[Mapping[str, float]] | None = None
) -> str:
    """Rows as a Markdown table; a value that does not exist is shown as "-".

    Args:
        rows: As `cells` takes them.
        spreads: For each row, standard deviations of some of its values.
    """
    lines = [
        "| " + " | ".join(heading for _, heading, _ in _COLUMNS) + " |",
        "|" + "|".join("---" if form == "s" else "---:" for _, _, form in _COLUMNS) + "|",
    ]
    spreads = spreads or [{}] * len(rows)
    lines += ["| " + " | ".join(cells(row, spread)) + " |" for row, spread in zip(rows, spreads, strict=True)]
    return "\n".join(lines) + "\n"


def headings() -> list[str]:
    """Headings of the table's columns."""
    return [heading for _, heading, _ in _COLUMNS]


def cells(row: Mapping[str, Any], spread: Mapping[str, float] | None = None) -> list[str]:
    """A row's cells as text, in the order of `headings`; `spread` is added to the values it has."""
    spread = spread or {}
    return [
        _format(row.get(key), form) + (f" ± {spread[key]:{form}}" if key in spread else "")
        for key, _, form in _COLUMNS
    ]


def _format(value: Any, form: str) -> str:
    if value is None:
        return "-"
    return str(value).replace("_", " ") if form == "s" else format(value, form)


def _markdown(report: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    host = report["machine"]
    notes = [
        f"- {data['name']}: {data['episodes']} episodes, {data['frames']} frames at {data['fps']:g} fps, "
        f"{data['singular_passages']} singular passages."
        + (" Its joint labels are synthetic (generated or retargeted)." if data["synthetic_labels"] else "")
        for data in report["datasets"]
    ]
    reasons = [
        "- "
        + ", ".join(str(row[key]).replace("_", " ") for key in ("solver", "mode", "dataset") if row[key])
        + f": {row['verdict']}, {row['reason']}."
        for row in rows
        if row.get("reason")
    ]
    return "\n".join(
        [
            "# Evaluation",
            "",
            markdown_table(rows),
            *notes,
            "",
            f"Latency: one query at a time, {report['settings'].get('latency_queries', '?')} queries after a "
            f"warm-up, on {host['processor']}, {host['torch_threads']} torch threads, "
            f"device {report['settings'].get('device') or 'cpu'}.",
            *(["", "Verdicts:", "", *reasons] if reasons else []),
            "",
        ]
    )


def _jsonable(row: Mapping[str, Any]) -> dict[str, Any]:
    """JSON knows no NaN and no infinity: they become null."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
