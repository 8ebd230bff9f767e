"""The live numbers as small pieces of HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

from lerobot_mimicik.viewing.session import FAILED, JUMPED, REACHED, Reading

Colour = tuple[int, int, int]

_GOOD, _SOME, _BAD = "#0ca30c", "#b87700", "#d03b3b"
_WARN = 0.1  # of half a joint's range: nearer to a limit than that a margin is marked


def card(name: str, colour: Colour, reading: Reading, joints: Sequence[str], described: str = "") -> str:
    """One solver: its status in words, errors, singularity, jerk, and a bar of the margin of every joint."""
    good = reading.status == REACHED
    tone = _GOOD if good else _BAD if reading.status in (FAILED, JUMPED) else _SOME
    near = int(np.argmin(reading.margins))
    cells = [
        ("error", f"{_short(reading.position_mm)} mm"),
        ("turned by", f"{_short(reading.rotation_deg)}°"),
        ("jerk, rad/s³", _short(reading.jerk)),
        ("largest step", f"{reading.step:.3f} rad"),
        ("singular, m/rad", f"{reading.singular_value:.3f}"),
        ("answers in", f"{_short(reading.milliseconds)} ms"),
    ]
    rows = "".join(
        f'<div><span style="opacity:.6">{label}</span><br><b style="font-variant-numeric:tabular-nums">{value}</b></div>'
        for label, value in cells
    )
    detail = f'<div style="color:{_BAD}">{html.escape(reading.detail[:200])}</div>' if reading.detail else ""
    return (
        f'<div title="{html.escape(described, quote=True)}" style="font-size:.78em;line-height:1.3;'
        f'margin:.35em .6em;padding:.45em .6em;border-left:.3em solid {_css(colour)};background:#8881">'
        f'<div style="display:flex;justify-content:space-between"><b>{html.escape(name)}</b>'
        f'<b style="color:{tone}">{"●" if good else "▲"} {html.escape(reading.status)}</b></div>{detail}'
        f'<div style="display:grid;grid-template-columns:1fr 1fr 1fr;gap:.1em .6em;margin:.3em 0">{rows}</div>'
        f'<div style="opacity:.6">room to limits; nearest: {html.escape(joints[near])}, '
        f"{100 * reading.margins[near]:.0f} %</div>"
        f'<div style="display:flex;gap:.25em">{"".join(map(_bar, joints, reading.margins))}</div></div>'
    )


def refused_note(refused: dict[str, str]) -> str:
    """Why solvers that were chosen are not there."""
    return "".join(
        f'<div style="font-size:.78em;margin:.35em .6em;color:{_BAD}"><b>{html.escape(name)}</b>: '
        f"{html.escape(why[:300])}</div>"
        for name, why in refused.items()
    )


def _bar(joint: str, margin: float) -> str:
    share = min(max(margin, 0.0), 1.0)
    colour = _BAD if margin < 0.01 else _SOME if margin < _WARN else "#888"
    return (
        f'<div title="{html.escape(joint, quote=True)}: {100 * margin:.0f} % of half its range from the nearer limit" '
        f'style="flex:1;height:.45em;background:#8883"><div style="height:100%;width:{100 * share:.0f}%;'
        f'background:{colour}"></div></div>'
    )


def _short(value: float) -> str:
    """Three digits, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def _css(colour: Colour) -> str:
    return f"rgb({colour[0]},{colour[1]},{colour[2]})"
