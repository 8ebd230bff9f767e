"""The pages of `mimicik bench` and `mimicik eval`, and the bench's results in Markdown."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lerobot_mimicik import outputs
from lerobot_mimicik.evaluation.evaluate import Evaluation
from lerobot_mimicik.evaluation.page import Card, Page, write_page
from lerobot_mimicik.evaluation.plots import (
    Plot,
    plot_closed_loop_error,
    plot_error_distribution,
    plot_passage,
)
from lerobot_mimicik.evaluation.report import machine
from lerobot_mimicik.evaluation.short_table import failed, legend, markdown, stress_legend, stress_markdown
from lerobot_mimicik.evaluation.tradeoff_plots import plot_failures, plot_tradeoff
from lerobot_mimicik.evaluation.words import (
    describe_rows,
    error_key,
    failures_markdown,
    where_peers_are_ahead,
)

Rows = Sequence[Mapping[str, Any]]
# First line of a document that the benchmark may write again.
DOCUMENT_MARK = "<!-- Written by mimicik bench: changes made by hand are lost. -->"


def check_document(path: Path) -> None:
    """See that a document may be written.

    Raises:
        FileExistsError: If a file is there that the benchmark did not write.
    """
    outputs.check_file(path, "--markdown", DOCUMENT_MARK.encode())


def write_bench_page(
    out: Path,
    rows: Rows,
    unavailable: Mapping[str, str],
    notes: Sequence[str],
    more: Sequence[Plot],
    command: str,
) -> Path:
    """Write `out`/report.html and the figures that are drawn from rows; returns the page's path.

    Args:
        out: Folder of the benchmark.
        rows: One for each solver, dataset and mode, seeds joined.
        unavailable: Why solvers are missing.
        notes: On the datasets.
        more: Further figures, saved already.
        command: The command line that repeats it.
    """
    plots = [plot for plot in (plot_tradeoff(rows), plot_failures(rows)) if plot is not None]
    for plot in plots:
        plot.save(out / "figures")
    solvers, sets = _unique(rows, "solver"), _unique(rows, "dataset")
    page = Page(
        title="Inverse kinematics solvers side by side",
        lead=f"{len(solvers)} solvers on {len(sets)} sets of motion: {', '.join(sets)}.",
        cards=_cards(rows),
        rows=rows,
        words=[*describe_rows(rows), *where_peers_are_ahead(rows)],
        notes=[*notes, *_missing(unavailable)],
        plots=[*plots, *more],
        commands=[command],
        facts=_facts("table.md, table.json"),
    )
    return write_page(out / "report.html", page)


def write_eval_page(
    out: Path,
    evaluations: Sequence[Evaluation],
    joint_names: Sequence[str],
    unavailable: Mapping[str, str],
    command: str,
) -> Path:
    """Write `out`/report.html of an evaluation; returns its path.

    Args:
        out: Folder of the report.
        evaluations: Its rows.
        joint_names: Of the arm.
        unavailable: Why solvers are missing.
        command: The command line that repeats it.
    """
    rows = [one.row for one in evaluations]
    judged = [one for one in evaluations if one.row["solver"] != "hold" and one.row["mode"] != "open_loop"]
    # The set with the deepest singularities says most about a solver that drives itself.
    shown = max(judged, key=lambda one: sum(map(len, one.recording.passages)), default=None)
    found: list[Plot | None] = [plot_tradeoff(rows), plot_error_distribution(evaluations)]
    if shown is not None:
        found += [plot_passage(shown, joint_names), plot_closed_loop_error(shown)]
    plots = [plot for plot in [*found, plot_failures(rows)] if plot is not None]
    for plot in plots:
        plot.save(out / "figures")
    solvers = [name for name in _unique(rows, "solver") if name != "hold"] or ["hold"]
    sets = _unique(rows, "dataset")
    page = Page(
        title=f"Evaluation of {', '.join(solvers)}",
        lead=f"Measured on {', '.join(sets)}. hold: the arm stays where it is; its error is what the data alone give.",
        cards=_cards([row for row in rows if row["solver"] in solvers]),
        rows=rows,
        words=describe_rows(rows),
        notes=_missing(unavailable),
        plots=plots,
        commands=[command],
        facts=_facts("report.md, report.json"),
    )
    return write_page(out / "report.html", page)


def results_markdown(rows: Rows, unavailable: Mapping[str, str], notes: Sequence[str], command: str) -> str:
    """The results as a Markdown document: what happened, tables, failures, where a peer is ahead, the command."""
    host = machine()
    ahead = where_peers_are_ahead(rows)
    failures = failures_markdown(rows)
    felt = stress_markdown(rows)
    lines = [
        DOCUMENT_MARK,
        "# Results",
        "",
        *(f"- {sentence}" for sentence in describe_rows(rows)),
        "",
        *(["## Where a peer is ahead", "", *(f"- {sentence}" for sentence in ahead), ""] if ahead else []),
        "## Tables",
        "",
        markdown(rows),
        f"{legend()}",
        "",
        *(["## Stress sets", "", felt, stress_legend(), ""] if felt else []),
        *(["## Failures by kind", "", failures] if failures else []),
        "## Data and machine",
        "",
        *(f"- {note}" for note in [*notes, *_missing(unavailable)]),
        f"- Processor: {host['processor']}, {host['torch_threads']} torch threads; torch {host['torch']}.",
        "",
        "Made by",
        "",
        f"    {command}",
        "",
    ]
    return "\n".join(lines)


def _cards(rows: Rows) -> list[Card]:
    """The headline of the first solver, on each of the first four sets in the last mode measured."""
    if not rows:
        return []
    own = [row for row in rows if str(row["solver"]).startswith(("guided", "mimicik"))] or list(rows)
    name, mode = own[0]["solver"], own[-1]["mode"]
    cards = []
    for row in [row for row in own if row["solver"] == name and row["mode"] == mode][:4]:
        value, jerk = row.get(error_key(row)), row.get("jerk_rms")
        against = ", clean target" if error_key(row) == "clean_mean_mm" else ""
        label = f"{name} on {row['dataset']}: mean error{against}; jerk {'-' if jerk is None else f'{jerk:.0f}'} rad/s³"
        label += "" if failed(row) == "-" else f", failed {failed(row)}"
        cards.append(Card("-" if value is None else f"{value:.2f} mm", label))
    return cards


def _facts(all_columns: str) -> dict[str, str]:
    host = machine()
    return {
        "processor": f"{host['processor']}, {host['cpu_count']} cores, {host['torch_threads']} torch threads",
        "versions": f"lerobot {version('lerobot')}, torch {host['torch']}, Python {sys.version.split()[0]}",
        "all columns": all_columns,
    }


def _missing(unavailable: Mapping[str, str]) -> list[str]:
    return [f"{name} is unavailable: {reason.splitlines()[0]}" for name, reason in unavailable.items()]


def _unique(rows: Rows, key: str) -> list[str]:
    return list(dict.fromkeys(str(row[key]) for row in rows))
