"""Training curves out of what `lerobot-train` prints."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

# LeRobot's console line: "... step:1K smpl:512K ep:30 epch:1.53 loss:0.123 grdn:1.2 lr:9.5e-04 ...".
_TRAIN_LINE = re.compile(r"step:\S+ smpl:\S+ (?P<metrics>.*)")
_METRIC = re.compile(r"(\S+?):(\S+)")
_EVAL_LINE = re.compile(r"step (\d+): eval_loss=(\S+)")
_BAR = re.compile(r"Training:\s+\d+%\|[^|]*\|\s*(\d+)/(\d+)")


@dataclass
class Curve:
    """A quantity over training steps."""

    steps: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def add(self, step: int, value: float) -> None:
        """Append one point."""
        self.steps.append(step)
        self.values.append(value)


@dataclass
class TrainingLog:
    """Reads a training run's output line by line.

    LeRobot rounds the step that it prints ("1K"), so steps are counted: it prints a line whenever the step
    is a multiple of `log_freq`. `TrainingLog(log_freq, step=start)` begins a log.

    Attributes:
        log_freq: Training steps between two lines.
        step: The last step known to be done.
        start: Where the run went on from, 0 unless it was resumed.
        curves: By LeRobot's names: loss, grdn (gradient norm), lr, ..., the policy's own losses, eval_loss.
    """

    log_freq: int
    step: int = 0
    curves: dict[str, Curve] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.log_freq < 1:
            raise ValueError(f"log_freq must be at least 1, got {self.log_freq}.")
        self.start = self.step
        self._logged = self.step

    def read(self, text: str) -> bool:
        """Take in one line, or one state of the progress bar; tells whether it was about progress."""
        bar = _BAR.search(text)
        if bar:
            self.step = max(self.step, self.start + int(bar[1]))
        line = _TRAIN_LINE.search(text)
        if line:
            self._count_line()
            for name, value in _METRIC.findall(line["metrics"]):
                number = _number(value)
                if number is not None:
                    self.curves.setdefault(name, Curve()).add(self._logged, number)
        evaluation = _EVAL_LINE.search(text)
        if evaluation:
            number = _number(evaluation[2])
            if number is not None:
                self.curves.setdefault("eval_loss", Curve()).add(int(evaluation[1]), number)
        return bool(bar or line or evaluation)

    def read_all(self, texts: Iterable[str]) -> TrainingLog:
        """Take in many lines; returns itself."""
        for text in texts:
            self.read(text)
        return self

    def _count_line(self) -> None:
        self._logged = (self._logged // self.log_freq + 1) * self.log_freq
        self.step = max(self.step, self._logged)

    def last(self, name: str) -> float | None:
        """The last value of a curve, or None."""
        curve = self.curves.get(name)
        return curve.values[-1] if curve else None


def joined(logs: Iterable[TrainingLog]) -> dict[str, Curve]:
    """Curves of a run and its resumptions, in order; a resumption replaces what ran beyond its start."""
    curves: dict[str, Curve] = {}
    for log in logs:
        for curve in curves.values():
            kept = sum(step <= log.start for step in curve.steps)
            del curve.steps[kept:], curve.values[kept:]
        for name, curve in log.curves.items():
            whole = curves.setdefault(name, Curve())
            whole.steps += curve.steps
            whole.values += curve.values
    return curves


def split_output(text: str) -> list[str]:
    """Lines and progress-bar states of console output; a bar is redrawn after a carriage return."""
    return [part for part in re.split(r"[\r\n]+", text) if part]


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
