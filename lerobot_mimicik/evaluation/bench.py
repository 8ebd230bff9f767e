"""The benchmark's rows: which policies they train, how seeds become one row, and the table of all.

A learned row is named after what is trained: `mimicik`, `mlp` and `unet_diffusion` as their recipes
say, with `_nofk` without the FK consistency loss, with `_fk0.2` under that weight of it. With `_guided` after all
that it is the same network as the prior of the guided solver, which is what the adapter runs.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_mimicik.checkpoints import KINDS
from lerobot_mimicik.evaluation.evaluate import Evaluation
from lerobot_mimicik.evaluation.report import definitions, markdown_table, unavailable_row

_KINDS = {kind.name: kind for kind in KINDS}
_NAME = re.compile(rf"(({'|'.join(_KINDS)})(?:_(nofk)|_fk(\d+(?:\.\d+)?))?)(_guided)?")
# Counts, of which a row shows the worst seed's.
_WORST = ("frames", "nonfinite", "episodes")
_QUANTILES = np.linspace(0, 1, 201)


@dataclass(frozen=True)
class LearnedRow:
    """A row whose policy is trained for the benchmark.

    Attributes:
        name: How the table calls it.
        trained: What is trained for it: the name of the network's own row.
        base: Name of the kind of policy, one of `checkpoints.KINDS`.
        fk_weight: Weight of the FK consistency loss; None is the recipe's.
    """

    name: str
    trained: str
    base: str
    fk_weight: float | None = None

    @classmethod
    def of(cls, name: str) -> LearnedRow | None:
        """The row with this name, or None if no learned row is called so."""
        found = _NAME.fullmatch(name)
        if found is None:
            return None
        trained, base, without, weight, _ = found.groups()
        return cls(name, trained, base, 0.0 if without else float(weight) if weight else None)

    @property
    def solver(self) -> str:
        """The solver that runs the checkpoint."""
        return "mimicik" if self.name == self.trained else "mimicik_guided"

    def recipe(self, size: str) -> str:
        """File name of the recipe it is trained by."""
        return _KINDS[self.base].recipe.format(size=size)

    def options(self) -> list[str]:
        """Options of `lerobot-train` beside the recipe's."""
        return [] if self.fk_weight is None else [f"--policy.fk_weight={self.fk_weight:g}"]

    def configuration(self, size: str) -> str:
        """What tables say beside the row."""
        loss = "as the recipe says" if self.fk_weight is None else f"weighted by {self.fk_weight:g}"
        recipe = f"recipe configs/{self.recipe(size)}, FK consistency loss {loss}"
        guided = "" if self.name == self.trained else "; its step is the guided solver's prior"
        return f"{_KINDS[self.base].about}; {recipe}; trained by lerobot-train{guided}"


def learned_names() -> str:
    """The names of learned rows, as messages list them."""
    return f"{', '.join(_KINDS)}, each also with _nofk or _fk0.2, and with _guided"


class Summary:
    """What a benchmark has measured so far, kept in `summary.json` so that it can go on.

    Attributes:
        rows: One mapping per solver, seed, dataset and mode: a row of `report.json` with its seed, the
            dataset's folder (`root`) and quantiles of its position error.
        training: What each training cost, by row and seed.
        unavailable: Why a row could not be measured, by its name; forgotten between runs.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        found = json.loads(path.read_text()) if path.is_file() else {}
        self.rows: list[dict[str, Any]] = found.get("rows", [])
        self.training: dict[str, dict[str, Any]] = found.get("training", {})
        self.unavailable: dict[str, str] = {}

    def find(self, solver: str, seed: int, root: str, mode: str) -> dict[str, Any] | None:
        """The row measured before, or None."""
        for row in self.rows:
            if (row["solver"], row["seed"], row["root"], row["mode"]) == (solver, seed, root, mode):
                return row
        return None

    def add(self, evaluation: Evaluation, seed: int, root: str) -> None:
        """Keep a measured row and save."""
        error = np.concatenate([trace.position_mm for trace in evaluation.traces])
        quantiles = np.quantile(np.where(np.isfinite(error), error, np.inf), _QUANTILES, method="lower")
        row = evaluation.row | {"seed": seed, "root": root, "error_quantiles_mm": quantiles.tolist()}
        self.rows.append({key: _jsonable(value) for key, value in row.items()})
        self.save()

    def save(self) -> None:
        """Write the file; an interruption leaves the old one or the new one."""
        content = {"rows": self.rows, "training": self.training, "unavailable": self.unavailable}
        self._path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self._path.with_suffix(".tmp")
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
        os.replace(temporary, self._path)


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], dict[str, float]]:
    """One row for several seeds of the same solver, dataset and mode.

    Returns:
        The row, of means (counts: the worst; verdicts: all that occurred), and the standard deviations of
        its numbers, which are empty for a single seed.
    """
    first = dict(rows[0])
    if len(rows) == 1:
        return first, {}
    spread: dict[str, float] = {}
    for key, value in first.items():
        values = [row.get(key) for row in rows]
        if key in _WORST:
            first[key] = max(row[key] for row in rows)
        elif isinstance(value, int | float | None) and key != "seed":
            numbers = [number for number in values if number is not None]
            first[key] = float(np.mean(numbers)) if len(numbers) == len(rows) else None
            if first[key] is not None:
                spread[key] = float(np.std(numbers, ddof=1))
    # A row measured before there were failures has none.
    if all("failures" in row for row in rows):
        first["failures"] = dict(sum((Counter(row["failures"]) for row in rows), Counter[str]()))
    first.pop("ci95", None)  # over recordings of one seed
    verdicts = Counter(row["verdict"] for row in rows)
    if len(verdicts) > 1:
        first["verdict"] = ", ".join(f"{name} {count}/{len(rows)}" for name, count in verdicts.most_common())
    first["seeds"] = len(rows)
    return first, spread


def joined_seeds(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each dataset, mode and solver, in the order in which they first appear."""
    return [row for row, _ in _over_groups(rows)]


def _over_groups(rows: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, float]]]:
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["dataset"], row["mode"], row["solver"]), []).append(row)
    return [over_seeds(group) for group in groups.values()]


def write_table(
    out: Path,
    rows: Sequence[dict[str, Any]],
    training: Mapping[str, Mapping[str, Any]],
    unavailable: Mapping[str, str],
    settings: Mapping[str, Any],
    notes: Sequence[str],
    configurations: Mapping[str, str],
) -> None:
    """Write `table.json` and `table.md`.

    Args:
        out: Folder.
        rows: Measured rows in the table's order; seeds of one solver, dataset and mode become one.
        training: As `Summary.training`.
        unavailable: As `Summary.unavailable`.
        settings: What the benchmark was asked to do.
        notes: Sentences on the datasets.
        configurations: How each row is configured and after what, by its name.
    """
    table = _over_groups(rows)
    missing = [unavailable_row(name, reason) for name, reason in unavailable.items()]
    shown = [row for row, _ in table] + missing
    spreads = [spread for _, spread in table] + [{} for _ in missing]
    content = {
        "rows": [
            {key: value for key, value in row.items() if key != "error_quantiles_mm"} | {"std": spread}
            for row, spread in table
        ],
        "training": training,
        "unavailable": unavailable,
        "configurations": configurations,
        "settings": settings,
        "definitions": definitions(),
    }
    (out / "table.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    most = max((row.get("seeds", 1) for row in shown), default=1)
    lines = ["# Benchmark", "", markdown_table(shown, spreads), *[f"- {note}" for note in notes]]
    if most > 1:
        lines += ["", f"Learned rows: mean ± standard deviation over up to {most} seeds."]
    if unavailable:
        lines += ["", "Unavailable:", "", *(f"- {name}: {reason}" for name, reason in unavailable.items())]
    lines += ["", "## Rows", "", *(f"- {name}: {text}." for name, text in configurations.items() if text)]
    if training:
        lines += ["", "## Training", "", "| run | steps | minutes | machine |", "|---|---:|---:|---|"]
        lines += [
            f"| {run} | {cost['steps']} | {cost['minutes']:.1f} | {cost['machine']} |"
            for run, cost in training.items()
        ]
    (out / "table.md").write_text("\n".join([*lines, ""]))


def _jsonable(value: Any) -> Any:
    """JSON knows no NaN and no infinity: they become null."""
    if isinstance(value, list):
        return [_jsonable(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
