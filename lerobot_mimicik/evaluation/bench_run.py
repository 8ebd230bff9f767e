"""The benchmark: trains every learned row that is not trained yet, measures all rows, writes table and figures.

Everything is kept in the output folder, and another run goes on where the last one stopped:

    train/<row>-seed<n>/   run/ is what `lerobot-train` writes, logs/ what it prints
    summary.json           every row measured so far, saved after each, and what each training cost
    anatomy/<row>.npz      its commands through singularities and out of reach
    table.json, table.md   the rows asked for, learned ones over their seeds
    figures/               the same as PNG, a caption beside each
    report.html            what happened in words, a short table, figures: one file
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from lerobot_mimicik import outputs
from lerobot_mimicik.checkpoints import FORESIGHT, LEARNED, kind_of, load_policy, solvers_of
from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.data.writer import ARM_FILE, read_arm_json
from lerobot_mimicik.evaluation.anatomy import Trial, load_commands, make_trials, run_trials, save_commands
from lerobot_mimicik.evaluation.bench import LearnedRow, Summary, joined_seeds, learned_names, write_table
from lerobot_mimicik.evaluation.bench_options import BenchOptions
from lerobot_mimicik.evaluation.bench_plots import plot_anatomy, plot_errors, plot_fk_weights, plot_seeds
from lerobot_mimicik.evaluation.bench_training import prepare_trainings, train_row
from lerobot_mimicik.evaluation.evaluate import StudiedSet, evaluate_one, study
from lerobot_mimicik.evaluation.latency import measure_latency
from lerobot_mimicik.evaluation.metrics import measure
from lerobot_mimicik.evaluation.plots import Plot
from lerobot_mimicik.evaluation.report import describe_recording
from lerobot_mimicik.evaluation.result_pages import check_document, results_markdown, write_bench_page
from lerobot_mimicik.evaluation.rollouts import known_modes
from lerobot_mimicik.evaluation.short_table import screen_table
from lerobot_mimicik.evaluation.trajectories import (
    Layout,
    distinct_names,
    first_seconds,
    load_trajectories,
)
from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.names import did_you_mean
from lerobot_mimicik.solvers import SolverUnavailable, known_solvers, make_solver, solver_configuration

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy


@dataclass(frozen=True)
class BenchResult:
    """What a benchmark came to.

    Attributes:
        failed: Whether a training failed.
        table: The short table, for a screen.
        page: The page's path.
    """

    failed: bool
    table: str
    page: Path


@dataclass(frozen=True)
class Measurement:
    """What each solver is measured on.

    Attributes:
        recording: A dataset, or the part of it that is used.
        mode: How it is driven along it.
        place: The dataset's folder and which part of it, as the summary knows it.
    """

    recording: StudiedSet
    mode: str
    place: str


def run_bench(
    options: BenchOptions,
    settings: Mapping[str, Any],
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> BenchResult:
    """Train, measure and write.

    Args:
        options: What to do.
        settings: The same as the user gave it, for the table.
        progress: Whether to show bars.
        say: Takes lines on what goes on.

    Raises:
        ValueError: If an option does not fit, or a row was trained with other options before.
        FileExistsError: If files would be replaced that no benchmark of this project wrote.
        FileNotFoundError: If a dataset or recipe does not exist.
    """
    rows = _checked(options)
    description = _arm(options)
    if options.markdown is not None:
        check_document(options.markdown)
    outputs.claim(options.out, "benchmark")
    checkpoint = load_policy(options.policy, options.device or None) if options.policy else None
    given = set() if checkpoint is None else _rows_of(kind_of(checkpoint.config), rows, options)
    trained = [row for name, row in rows.items() if row is not None and name not in given]
    trainings = prepare_trainings(options, description, trained)
    arm = SerialArm(description, dtype=torch.float64)
    trials = make_trials(description) if description.home else []
    measurements = _measurements(options, arm)
    digests = dict.fromkeys(given, checkpoint.digest()) if checkpoint is not None else {}
    bench = _Bench(options, settings, arm, rows, digests, measurements, trials, progress, say)
    failed = False
    for name, row in rows.items():
        for seed in range(options.seeds if row is not None and name not in given else 1):
            policy: LearnedIKPolicy | str | None = checkpoint if name in given else None
            if row is not None and name not in given:
                training = trainings[row.trained, seed]
                try:
                    train_row(training, bench.summary, say)
                except RuntimeError as error:
                    # The other rows are still worth having; the exit status tells.
                    failed = True
                    bench.summary.unavailable[name] = f"training failed: {str(error).splitlines()[0]}"
                    say(f"{name}, seed {seed}: {error}")
                    break
                policy = str(training.run)
            if not bench.measure(name, seed, policy):
                break
            bench.write()
    bench.write()
    bench.write_anatomy()
    return bench.conclude(failed)


def _checked(options: BenchOptions) -> dict[str, LearnedRow | None]:
    """The rows by name, None for solvers that are not trained here, once every option is known to fit."""
    if not options.datasets:
        raise ValueError("--datasets is missing: folders of LeRobot datasets to measure on.")
    if options.seeds < 1:
        raise ValueError(f"--seeds={options.seeds}: expected at least 1.")
    for mode in options.modes:
        if mode not in known_modes():
            raise ValueError(
                f"--modes: unknown {mode}; known are {', '.join(known_modes())}."
                + did_you_mean(mode, known_modes())
            )
    rows = {name: LearnedRow.of(name) for name in options.solvers}
    others = [name for name in known_solvers() if LearnedRow.of(name) is None]
    for name, row in rows.items():
        if row is None and name not in others:
            raise ValueError(
                f"--solvers: unknown {name}; known are {learned_names()}, and {', '.join(others)}."
                + did_you_mean(name, [*LEARNED, *others])
            )
        if row is not None and options.train is None and not (options.policy and row.trained == "mimicik"):
            raise ValueError(
                f"--solvers names {name}, which is trained here: on which dataset? --train=..."
                + (", or which checkpoint is it? --policy.path=..." if row.trained == "mimicik" else "")
            )
    return rows


def _rows_of(kind: str, rows: Mapping[str, LearnedRow | None], options: BenchOptions) -> set[str]:
    """The rows that are measured with a checkpoint of this kind. ValueError if there is none, or one would need another."""
    if kind == FORESIGHT.name:
        given = set(rows) & set(solvers_of(kind))
        untrained = [name for name, row in rows.items() if row is not None and options.train is None]
        if untrained:
            raise ValueError(
                f"--solvers names {untrained[0]}, but {options.policy} is a checkpoint of {kind}: --train=... names the "
                "dataset to train it on"
            )
    else:
        given = {name for name, row in rows.items() if row is not None and row.trained == "mimicik"}
    if not given:
        raise ValueError(
            f"--policy.path={options.policy} is a checkpoint of {kind}, and no row of --solvers is measured with it: "
            f"{', '.join(solvers_of(kind))}"
        )
    return given


def _arm(options: BenchOptions) -> ArmDescription:
    """The arm that was named, else that of the training data or of the first dataset."""
    if options.arm:
        return describe_arm(options.arm)
    root = options.train or options.datasets[0]
    if not (root / ARM_FILE).is_file():
        raise ValueError(f"{root} does not name its arm ({ARM_FILE}): which is it? --arm=...")
    return read_arm_json(root)


def _measurements(options: BenchOptions, arm: SerialArm) -> list[Measurement]:
    """Every dataset in every mode."""
    layout = Layout(
        joint_units=options.joint_units,
        target=options.target,
        state_joint_names=options.state_joint_names or None,
        any_arm=bool(options.arm),
    )
    measurements: list[Measurement] = []
    for root, name in zip(options.datasets, distinct_names(options.datasets), strict=True):
        whole = load_trajectories(root, arm, layout, options.episodes or None, name)
        kept = study(arm, first_seconds(whole, of_each=options.seconds or math.inf))
        for mode in options.modes:
            if mode.startswith("plant") and options.plant_seconds:
                part = study(arm, first_seconds(kept.set, in_all=options.plant_seconds))
                measurements.append(Measurement(part, mode, _place(options, root, options.plant_seconds)))
            else:
                measurements.append(Measurement(kept, mode, _place(options, root)))
    return measurements


def _place(options: BenchOptions, root: Path, in_all: float = 0.0) -> str:
    """What was measured on, as the summary knows it."""
    return "".join(
        [
            str(root),
            f", episodes {','.join(map(str, options.episodes))}" if options.episodes else "",
            f", first {options.seconds:g} s of each" if options.seconds else "",
            f", first {in_all:g} s in all" if in_all else "",
        ]
    )


class _Bench:
    """One benchmark under way: measures row after row and writes what there is."""

    def __init__(
        self,
        options: BenchOptions,
        settings: Mapping[str, Any],
        arm: SerialArm,
        rows: Mapping[str, LearnedRow | None],
        digests: Mapping[str, str],
        measurements: Sequence[Measurement],
        trials: Sequence[Trial],
        progress: bool,
        say: Callable[[str], None],
    ) -> None:
        self._options, self._settings = options, settings
        self._arm, self._learned, self._names = arm, rows, list(rows)
        # Of checkpoints that were given: another one is another row.
        self._digests = digests
        self._measurements, self._trials = measurements, trials
        self._progress, self._say = progress, say
        self.summary = Summary(options.out / "summary.json")
        self._plots: dict[str, Plot] = {}

    def measure(self, name: str, seed: int, policy: LearnedIKPolicy | str | None) -> bool:
        """Measure one solver wherever it was not measured before; False if it cannot be had."""
        missing = [
            each
            for each in self._measurements
            if self.summary.find(name, seed, self._place(name, each), each.mode) is None
        ]
        commands = self._commands_file(name)
        on_trial = bool(self._trials) and seed == 0 and not commands.is_file()
        if not missing and not on_trial:
            return True
        chosen: dict[str, Any] = {}
        if policy is not None:
            chosen = {"policy": policy, "device": self._options.device or None}
        row = self._learned[name]
        try:
            solver = make_solver(name if row is None else row.solver, self._arm, **chosen)
        except (RuntimeError, ImportError) as error:
            self.summary.unavailable[name] = str(error)
            self._say(f"{name} is unavailable: {error}")
            return False
        if missing:
            first = missing[0].recording.set.trajectories[0]
            latency = measure_latency(solver, first, self._options.latency_queries)
        for each in missing:
            try:
                evaluation = evaluate_one(
                    self._arm, name, solver, each.recording, each.mode, latency, seed, self._progress
                )
            except SolverUnavailable as error:
                self.summary.unavailable[f"{name}, {each.mode}"] = str(error)
                self._say(f"{name} is unavailable: {error}")
                continue
            self.summary.add(evaluation, seed, self._place(name, each))
        if on_trial:
            save_commands(commands, run_trials(solver, self._trials))
        return True

    def _place(self, name: str, measurement: Measurement) -> str:
        digest = self._digests.get(name)
        return measurement.place if digest is None else f"{measurement.place}, checkpoint {digest[:12]}"

    def _configuration(self, name: str, row: LearnedRow | None) -> str:
        """What tables say beside a row."""
        if name in self._digests:
            solver = name if row is None else row.solver
            return f"{solver_configuration(solver)} (--policy.path={self._options.policy})"
        return solver_configuration(name) if row is None else row.configuration(self._options.size)

    def _rows(self) -> list[dict[str, Any]]:
        """The measured rows among those of this run, one for each seed."""
        asked = [
            (self.summary.find(name, seed, self._place(name, each), each.mode), each.recording.set.name)
            for each in self._measurements
            for name in self._names
            for seed in range(self._options.seeds)
        ]
        # A dataset's name is told from the others asked for now, which may be others than before.
        return [row | {"dataset": dataset} for row, dataset in asked if row is not None]

    def _about(self) -> list[dict[str, Any]]:
        return [describe_recording(each.recording) | {"mode": each.mode} for each in self._measurements]

    def _notes(self) -> list[str]:
        return [
            f"{data['name']}, {data['mode'].replace('_', ' ')}: {data['episodes']} episodes, {data['frames']} "
            f"frames at {data['fps']:g} fps."
            + (
                " Its joint labels are synthetic (generated or retargeted)."
                if data["synthetic_labels"]
                else ""
            )
            for data in self._about()
        ]

    def write(self) -> None:
        """The table and figures of the measured rows among those of this run."""
        rows = self._rows()
        self.summary.save()
        configurations = {name: self._configuration(name, row) for name, row in self._learned.items()}
        write_table(
            self._options.out,
            rows,
            self.summary.training,
            self.summary.unavailable,
            dict(self._settings) | {"datasets": self._about()},
            self._notes(),
            configurations,
        )
        if rows:
            self._save_plots(
                [*plot_errors(rows), plot_fk_weights(rows, MimicIKConfig.fk_weight), plot_seeds(rows)]
            )

    def conclude(self, failed: bool) -> BenchResult:
        """The page, the Markdown document where it is asked for, and the table for the screen."""
        rows = joined_seeds(self._rows())
        options, unavailable, notes = self._options, self.summary.unavailable, self._notes()
        page = write_bench_page(
            options.out, rows, unavailable, notes, list(self._plots.values()), options.command
        )
        if options.markdown is not None:
            options.markdown.write_text(results_markdown(rows, unavailable, notes, options.command))
        return BenchResult(failed, screen_table(rows, unavailable), page)

    def write_anatomy(self) -> None:
        """The figure of the standard motions, learned rows with their first seed."""
        files = {name: self._commands_file(name) for name in self._names}
        traces = {
            name: measure(self._arm, list(load_commands(file, self._trials).values()))
            for name, file in files.items()
            if self._trials and file.is_file()
        }
        if traces:
            self._save_plots(plot_anatomy(self._trials, traces, self._arm.joint_names))

    def _commands_file(self, name: str) -> Path:
        digest = self._digests.get(name, "")
        return self._options.out / "anatomy" / f"{name}{digest and '-'}{digest[:12]}.npz"

    def _save_plots(self, plots: Sequence[Plot | None]) -> None:
        """Figures that can be drawn, as PNG with the caption beside it."""
        for plot in plots:
            if plot is not None:
                self._plots[plot.name] = plot
                caption = plot.save(self._options.out / "figures").with_suffix(".txt")
                caption.write_text(f"{plot.title}\n\n{plot.caption}\n")
