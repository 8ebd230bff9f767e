"""The report as one HTML page: headline figures, table, plots with captions; images are inside the page."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_mimicik.evaluation.animation import Animation
from lerobot_mimicik.evaluation.plots import Plot
from lerobot_mimicik.evaluation.short_table import COLUMNS, FAILED, cells, failed, groups, legend

_STYLE = """
:root { --ink: #1b2733; --soft: #5c6b7a; --line: #dde3e8; --accent: #0072B2; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 880px; padding: 40px 24px 64px;
  color: var(--ink); background: #fff;
  font: 16px/1.55 system-ui, "Segoe UI", "Helvetica Neue", Arial, "DejaVu Sans", sans-serif; }
h1 { font-size: 27px; line-height: 1.2; margin: 0 0 6px; }
h2 { font-size: 20px; margin: 44px 0 10px; }
p { margin: 0 0 12px; }
.lead { color: var(--soft); margin-bottom: 24px; }
.cards { margin-top: 28px; display: grid; grid-template-columns: repeat(4, 1fr); gap: 12px; }
.card { border: 1px solid var(--line); border-top: 3px solid var(--accent);
  border-radius: 6px; padding: 14px; }
.card b { display: block; font-size: 25px; line-height: 1.2; font-variant-numeric: tabular-nums; }
.card span { display: block; color: var(--soft); font-size: 13px; line-height: 1.35; margin-top: 4px; }
table { border-collapse: collapse; width: 100%; font-size: 12.5px; font-variant-numeric: tabular-nums; }
th, td { padding: 5px 5px; text-align: right; white-space: nowrap; }
th { font-weight: 600; white-space: normal; vertical-align: bottom; border-bottom: 1px solid var(--ink); cursor: help; }
th:first-child, td:first-child { text-align: left; }
td { border-bottom: 1px solid var(--line); }
tr.group td { padding-top: 14px; font-weight: 600; text-align: left; color: var(--accent); }
tr.reference td { color: var(--soft); }
ul { margin: 0; padding-left: 20px; } li { margin-bottom: 6px; }
figure { margin: 0; }
img { display: block; width: 100%; height: auto; }
figcaption, .note { color: var(--soft); font-size: 14px; margin-top: 8px; }
pre { background: #f5f7f9; border-radius: 6px; padding: 12px; overflow-x: auto; font-size: 13px; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 16px; font-size: 14px; margin: 0; }
dt { color: var(--soft); } dd { margin: 0; }
@media (max-width: 640px) { .cards { grid-template-columns: repeat(2, 1fr); } .scroll { overflow-x: auto; } }
"""


@dataclass(frozen=True)
class Card:
    """A headline figure and what it is."""

    value: str
    label: str


@dataclass(frozen=True)
class Page:
    """What the page says, from top to bottom.

    Attributes:
        title: Heading.
        lead: A sentence below it.
        cards: Headline figures.
        rows: Rows of the report.
        first: What is seen before anything else.
        words: Sentences on what happened, above the table.
        notes: Sentences below the table.
        plots: Figures.
        commands: Command lines that repeat the work.
        facts: Name and value of what the figures depend on (machine, versions, settings).
    """

    title: str
    lead: str
    cards: Sequence[Card]
    rows: Sequence[Mapping[str, Any]]
    first: Animation | None = None
    words: Sequence[str] = ()
    notes: Sequence[str] = ()
    plots: Sequence[Plot] = ()
    commands: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)


def write_page(path: str | Path, page: Page) -> Path:
    """Write the page as one file that needs no other; returns its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render(page), encoding="utf-8")
    return path


def render(page: Page) -> str:
    """The page as HTML text."""
    text = _text
    cards = "".join(
        f'<div class="card"><b>{text(card.value)}</b><span>{text(card.label)}</span></div>'
        for card in page.cards
    )
    words = "".join(f"<li>{text(sentence)}</li>" for sentence in page.words)
    happened = f"<h2>What happened</h2><ul>{words}</ul>" if words else ""
    first = _figure(page.first) if page.first is not None else ""
    notes = "".join(f'<p class="note">{text(note)}</p>' for note in page.notes)
    figures = "".join(_figure(plot) for plot in page.plots)
    commands = f"<h2>Commands</h2><pre>{text(chr(10).join(page.commands))}</pre>" if page.commands else ""
    facts = "".join(f"<dt>{text(name)}</dt><dd>{text(value)}</dd>" for name, value in page.facts.items())
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{text(page.title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{text(page.title)}</h1>
<p class="lead">{text(page.lead)}</p>
{first}
<div class="cards">{cards}</div>
{happened}
<h2>Accuracy, smoothness and latency</h2>
<div class="scroll">{_table(page.rows)}</div>
{notes}
{figures}
{commands}
<h2>Made with</h2>
<dl>{facts}</dl>
</body>
</html>
"""


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """One group of rows for each dataset and mode."""
    meanings = [(heading, why) for _, heading, why, _ in COLUMNS]
    head = "".join(
        f'<th title="{html.escape(why)}">{html.escape(name)}</th>' for name, why in [*meanings, FAILED]
    )
    body = []
    for title, members in groups(rows):
        body.append(f'<tr class="group"><td colspan="{len(COLUMNS) + 2}">{html.escape(title)}</td></tr>')
        for row in members:
            values = "".join(f"<td>{html.escape(value)}</td>" for value in cells(row)[:-1])
            kind = ' class="reference"' if row["solver"] == "hold" else ""
            body.append(
                f"<tr{kind}><td>{html.escape(row['solver'])}</td>{values}"
                f'<td title="{html.escape(row.get("reason", ""))}">{html.escape(failed(row))}</td></tr>'
            )
    return (
        f"<table><thead><tr><th>solver</th>{head}</tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table>"
        f'<p class="note">{html.escape(legend())}</p>'
    )


def _text(text: str) -> str:
    """Escaped, with units kept on the line of their number."""
    return re.sub(r"(?<=\d) (?=(mm|m|ms|s|rad|%)\b|%)", "\u00a0", html.escape(text))


def _figure(plot: Plot | Animation) -> str:
    media, data = plot.image()
    title, caption = _text(plot.title), _text(plot.caption)
    return (
        f'<h2>{title}</h2><figure><img alt="{title}" style="max-width:{plot.width}px" '
        f'src="data:{media};base64,{base64.b64encode(data).decode()}"><figcaption>{caption}</figcaption></figure>'
    )
