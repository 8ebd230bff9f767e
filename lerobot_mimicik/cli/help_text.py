"""The help of a subcommand: its options by group with defaults, short enough for a screen."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, get_type_hints

_WIDEST = 110  # columns: longer lines are hard to read
_INDENT = 26  # columns of an option and its default before what it does
_INLINE = 3  # options of a group that are shown with the others; a larger group has a help of its own


def help_text(config_class: type, prog: str, group: str = "") -> str:
    """What `prog --help` prints, or `prog --help=GROUP` for one group of options.

    Args:
        config_class: A dataclass whose fields are the options; the comments above them say what they do.
        prog: The command.
        group: A field of `config_class` that is a dataclass, or "all"; empty: the command's own options.

    Raises:
        ValueError: There is no such group.
    """
    kinds, groups = get_type_hints(config_class), _groups(config_class)
    if group and group not in (*groups, "all"):
        raise ValueError(f"{prog} has no options --{group}.*; groups are {', '.join(groups) or 'none'}.")
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    lines = [f"usage: {prog} [--option=value ...]", "", *_about_lines(config_class, width)]
    own = [each for each in fields(config_class) if not is_dataclass(kinds[each.name])]
    if not group or group == "all":
        lines += ["", *_options(config_class, own, "--", width)]
    for name in groups:
        inner: Any = kinds[name]
        inside = list(fields(inner))
        if group not in (name, "all") and (group or len(inside) > _INLINE):
            continue
        lines += ["", *_wrapped(_about(inner), width, ""), *_options(inner, inside, f"--{name}.", width)]
    if not group and (hidden := [name for name in groups if len(fields(kinds[name])) > _INLINE]):
        lines.append("")
        for name in hidden:
            count = len(fields(kinds[name]))
            said = f"{_about(kinds[name]).rstrip('.')}: {count} options, shown by {prog} --help={name}"
            lines += _described(f"--{name}.*", said, width)
    return "\n".join(lines)


def _groups(config_class: type) -> list[str]:
    return [name for name, kind in get_type_hints(config_class).items() if is_dataclass(kind)]


def _about_lines(config_class: type, width: int) -> list[str]:
    """Its docstring; an example stays in one line, to be copied."""
    text, _, example = _about(config_class).partition("Example: ")
    return [*_wrapped(text, width, ""), *(["", f"Example: {example.strip('`')}"] if example else [])]


def _about(config_class: type) -> str:
    return " ".join((config_class.__doc__ or "").split())


def _options(config_class: type, options: list[Field], prefix: str, width: int) -> Iterator[str]:
    from draccus.wrappers.docstring import get_attribute_docstring

    for each in options:
        said = " ".join(get_attribute_docstring(config_class, each.name).comment_above.split())
        yield from _described(f"{prefix}{each.name}={_default(each)}", said, width)


def _default(option: Field) -> str:
    value = option.default
    if value is MISSING:
        value = option.default_factory() if option.default_factory is not MISSING else "..."
    return "" if value in ("", None, []) else str(value).lower() if isinstance(value, bool) else str(value)


def _described(option: str, said: str, width: int) -> list[str]:
    lines = _wrapped(said, width, " " * _INDENT)
    head = f"  {option}"
    if len(head) < _INDENT and lines:
        return [head.ljust(_INDENT) + lines[0].lstrip(), *lines[1:]]
    return [head, *lines]


def _wrapped(text: str, width: int, indent: str) -> list[str]:
    # Choices and examples hold together: a line never breaks inside a word with hyphens.
    return textwrap.wrap(
        text,
        width,
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
