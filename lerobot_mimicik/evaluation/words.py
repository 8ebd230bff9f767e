"""What happened, in words: who was most exact, who was smoothest, what failed, where a peer is ahead."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_mimicik.evaluation.short_table import groups
from lerobot_mimicik.evaluation.verdict import FAILURES

_OWN = ("mimicik", "guided")  # what this project's own rows begin with
_REFERENCES = ("hold", "limit")  # no solvers that one could run
Rows = Sequence[Mapping[str, Any]]

FAILURE_WORDS = {
    "non-finite": "a command that is not finite",
    "E-stop": "a joint step over 0.5 rad",
    "frozen": "an arm that stood still while its target moved on",
    "caught": "an error not back under 10 mm within 2 s of a singularity",
    "lost": "an error that grew without return",
}


def error_key(row: Mapping[str, Any]) -> str:
    """The error that counts in a row: against the clean target where there is one."""
    return "mean_mm" if row.get("clean_mean_mm") is None else "clean_mean_mm"


def describe_rows(rows: Rows) -> list[str]:
    """A sentence for each dataset and mode."""
    sentences = []
    for title, members in groups(rows):
        solvers = [row for row in members if row["solver"] not in _REFERENCES and _known(row)]
        if not solvers:
            continue
        exact = min(solvers, key=lambda row: row[error_key(row)])
        alone = len(solvers) == 1
        sentence = f"{title}: {exact['solver']} is {'' if alone else 'the most exact, '}"
        sentence += f"{_number(exact[error_key(exact)])} mm {'off ' if alone else ''}on average"
        sentence += " against the clean target" if error_key(exact) == "clean_mean_mm" else ""
        # A solver that fails is smooth for the wrong reason.
        sound = [row for row in solvers if not _failures(row)]
        if sound:
            smooth = min(sound, key=lambda row: row["jerk_rms"])
            who = "it" if smooth is exact else smooth["solver"]
            sentence += "; its" if alone else f"; {who} is the smoothest without a failure,"
            sentence += f" jerk {'is ' if alone else ''}{_number(smooth['jerk_rms'])} rad/s³"
        bad = [f"{row['solver']} {_failures(row)}" for row in solvers if _failures(row)]
        sentence += f"; recordings that failed: {', '.join(bad)}" if bad else ""
        sentences.append(sentence + ".")
    return sentences


def where_peers_are_ahead(rows: Rows) -> list[str]:
    """Where a peer has both less error and less jerk than this project's best row; one sentence says if nowhere."""
    sentences, compared = [], False
    for title, members in groups(rows):
        solvers = [row for row in members if row["solver"] not in _REFERENCES and _known(row)]
        own = [row for row in solvers if row["solver"].startswith(_OWN)]
        peers = [row for row in solvers if row not in own]
        if not own or not peers:
            continue
        compared = True
        best = min(own, key=lambda row: (_failures(row), row[error_key(row)]))
        ahead = [
            f"{row['solver']} ({_number(row[error_key(row)])} mm, {_number(row['jerk_rms'])} rad/s³)"
            for row in peers
            if row[error_key(row)] < best[error_key(best)]
            and row["jerk_rms"] < best["jerk_rms"]
            and _failures(row) <= _failures(best)
        ]
        if ahead:
            sentences.append(
                f"{title}: ahead of {best['solver']} ({_number(best[error_key(best)])} mm, "
                f"{_number(best['jerk_rms'])} rad/s³) in both error and jerk: {', '.join(ahead)}."
            )
    if compared and not sentences:
        sentences.append("On no set is a peer ahead of this project's best row in both error and jerk.")
    return sentences


def count_failures(rows: Rows) -> dict[str, Counter[str]]:
    """Failed recordings of each solver by kind, over all datasets and modes that can fail."""
    found: dict[str, Counter[str]] = {}
    for row in rows:
        if row.get("verdict") not in ("-", None) and "failures" in row:
            found.setdefault(row["solver"], Counter()).update(row["failures"])
    return found


def failures_markdown(rows: Rows) -> str:
    """Failed recordings by solver and kind, as a Markdown table."""
    counts = count_failures(rows)
    if not counts:
        return ""
    lines = ["| solver | " + " | ".join(FAILURES) + " |", "|---" + "|---:" * len(FAILURES) + "|"]
    lines += [
        f"| {name} | " + " | ".join(str(one[kind]) for kind in FAILURES) + " |"
        for name, one in counts.items()
    ]
    kinds = "; ".join(f"{kind}: {why}" for kind, why in FAILURE_WORDS.items())
    return "\n".join([*lines, "", f"{kinds[:1].upper()}{kinds[1:]}.", ""])


def _known(row: Mapping[str, Any]) -> bool:
    return row.get(error_key(row)) is not None and row.get("jerk_rms") is not None


def _failures(row: Mapping[str, Any]) -> int:
    return sum(row.get("failures", {}).values())


def _number(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
