"""The report of `mimicik demo`: chooses what goes on the page and says where it comes from."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import torch

from lerobot_mimicik.data.writer import read_arm_json
from lerobot_mimicik.evaluation.animation import Animation, animate
from lerobot_mimicik.evaluation.evaluate import Evaluation
from lerobot_mimicik.evaluation.page import Card, Page, write_page
from lerobot_mimicik.evaluation.plots import (
    Plot,
    plot_closed_loop_error,
    plot_error_distribution,
    plot_passage,
    plot_training,
    plot_workspace,
)
from lerobot_mimicik.evaluation.report import machine
from lerobot_mimicik.evaluation.side_by_side import follow
from lerobot_mimicik.evaluation.training_log import Curve
from lerobot_mimicik.evaluation.trajectories import load_trajectories
from lerobot_mimicik.evaluation.words import describe_rows
from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.chain import SerialArm

_SOURCES = {
    "synthetic": "Motion and joint labels are generated: synthetic teleoperation, no robot was involved.",
    "ee": "The motion is recorded; the joint labels were made from it by retargeting and are synthetic. "
    "The near-singular trajectories are generated.",
}


def write_demo_report(
    output: Path,
    source: str,
    train_root: Path,
    data_summary: str,
    evaluations: Sequence[Evaluation],
    curves: Mapping[str, Curve],
    steps: int,
    commands: Sequence[str],
) -> Path:
    """Write figures and page of a finished demo; returns the page's path.

    Args:
        output: The demo's folder.
        source: "synthetic" or "ee".
        train_root: The training dataset.
        data_summary: What was said when the data were made.
        evaluations: Of the policy, the guided solver and holding still, on the test set and then on the near-singular one.
        curves: Training curves.
        steps: Training steps.
        commands: Command lines that repeat training and evaluation.
    """
    policy = [one for one in evaluations if one.row["solver"] not in ("guided", "hold")]
    test, ood = (
        [one for one in policy if one.recording is recording]
        for recording in dict.fromkeys(one.recording for one in policy)
    )
    closed_test, closed_ood = _closed(test), _closed(ood)
    arm = SerialArm(read_arm_json(train_root), dtype=torch.float64)
    train = load_trajectories(train_root, arm, name="train")
    plots = [
        plot_error_distribution(evaluations),
        plot_passage(closed_ood, arm.joint_names),
        plot_closed_loop_error(closed_ood),
        plot_training(curves),
        plot_workspace(train, [one.recording.set for one in (closed_test, closed_ood)]),
    ]
    shown: list[Plot] = [plot for plot in plots if plot is not None]
    for plot in shown:
        plot.save(output / "figures")
    first = singularity_animation(arm.description)
    if first is not None:
        first.save(output / "figures")
    host = machine()
    page = Page(
        title="MimicIK: inverse kinematics from teleoperation",
        lead=f"A policy was trained on {train.frames} frames for {steps} steps with lerobot-train, and "
        "measured on sessions that it has not seen and near singularities.",
        cards=_cards(test, closed_test, closed_ood, _guided(evaluations, closed_ood)),
        rows=[one.row for one in evaluations],
        first=first,
        words=describe_rows([one.row for one in evaluations]),
        notes=[_SOURCES[source], _rows_note(evaluations), *_verdict_notes(policy)],
        plots=shown,
        commands=commands,
        facts={
            "data": data_summary.replace("\n", "; "),
            "processor": f"{host['processor']}, {host['cpu_count']} cores",
            "threads": f"{host['torch_threads']} for latency and evaluation",
            "versions": f"lerobot {version('lerobot')}, torch {host['torch']}, "
            f"Python {sys.version.split()[0]}",
            "all columns": "eval/report.md, eval/report.json",
        },
    )
    return write_page(output / "report.html", page)


def singularity_animation(description: ArmDescription) -> Animation | None:
    """An arm led through a singularity by two solvers; None for one that has none."""
    shown = follow(description)
    return None if shown is None else animate(shown)


def _cards(
    test: Sequence[Evaluation], closed_test: Evaluation, closed_ood: Evaluation, guided: Evaluation
) -> list[Card]:
    open_row = next(one.row for one in test if one.row["mode"] == "open_loop")
    return [
        Card(
            _mm(open_row["mean_mm"]),
            f"mean error in open loop, unseen sessions (P95 {_mm(open_row['p95_mm'])})",
        ),
        Card(
            _mm(closed_test.row["mean_mm"]),
            f"mean error when it drives itself (P95 {_mm(closed_test.row['p95_mm'])})",
        ),
        Card(
            guided.row["verdict"],
            f"near singularities, the guided solver: {guided.row['sr10']:.1f} % of frames within 10 mm; the policy alone: "
            f"{closed_ood.row['verdict']}, {closed_ood.row['sr10']:.1f} %",
        ),
        Card(
            f"{open_row['latency_ms_median']:.1f} ms",
            f"for one query, asked alone (p99 {open_row['latency_ms_p99']:.1f} ms)",
        ),
    ]


def _rows_note(evaluations: Sequence[Evaluation]) -> str:
    open_hold = [
        one.row for one in evaluations if one.row["solver"] == "hold" and one.row["mode"] == "open_loop"
    ]
    parts = [f"{_mm(row['mean_mm'])} on {row['dataset']}" for row in open_hold]
    return (
        "test: sessions kept aside. ood: near-singular trajectories. Open loop: recorded joints in at every "
        "frame. Closed loop: every command is the next measurement. guided: the solver that drives an arm, here without "
        "the policy. hold: the arm stays where it is; in open "
        f"loop its error is the distance between the arm and its target: {' and '.join(parts)}. That is what "
        "the data alone give."
    )


def _verdict_notes(policy: Sequence[Evaluation]) -> list[str]:
    rows = [one.row for one in policy if one.row["verdict"] not in ("-", "Bounded")]
    return [f"{row['dataset']}, closed loop: {row['verdict']}, {row['reason']}." for row in rows]


def _guided(evaluations: Sequence[Evaluation], beside: Evaluation) -> Evaluation:
    """The guided solver on the same recordings in the same mode."""
    where = (beside.row["dataset"], beside.row["mode"])
    return next(
        (
            one
            for one in evaluations
            if one.row["solver"] == "guided" and (one.row["dataset"], one.row["mode"]) == where
        ),
        beside,
    )


def _closed(evaluations: Sequence[Evaluation]) -> Evaluation:
    return next(one for one in evaluations if one.row["mode"] == "closed_loop")


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} mm"
