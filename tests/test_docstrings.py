"""Docstrings: one dialect, where ruff's pydocstyle has no rule for it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_ENTRY = re.compile(r" {4}(?P<names>[*\w., ]+)(?: \([^)]*\))?: (?P<words>.*)")
_NAMES = ("q", "x y z", "float")  # an entry may begin with these in lower case


def docstrings(path: Path) -> Iterator[tuple[str, str]]:
    """Place and text of every docstring of a file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}", text


def entries(text: str) -> Iterator[str]:
    """What is said of each argument, attribute and error of a docstring."""
    for section in re.findall(r"^(?:Args|Attributes|Raises):\n((?:(?: .*)?\n?)*)", text, re.MULTILINE):
        for entry in re.split(r"\n(?= {4}\S)", section.rstrip()):
            matched = _ENTRY.fullmatch(entry.splitlines()[0])
            if matched:
                yield " ".join([matched["words"], *map(str.strip, entry.splitlines()[1:])])


def python_files() -> list[Path]:
    """The project's own."""
    tops = ("lerobot_mimicik", "robot_adapters", "examples", "tests")
    return [path for top in tops for path in sorted((ROOT / top).rglob("*.py"))]


def test_code_in_prose_has_single_backticks():
    marks = re.compile(r"(?<!`)``(?!`)|:(?:class|func|meth|mod|attr|ref):`|::$", re.MULTILINE)
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in python_files()
        if path != Path(__file__)
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if marks.search(line)
    ]
    assert not found, found


def test_arguments_attributes_and_errors_are_described_in_sentences():
    wrong = [
        f"{place}: {words}"
        for path in python_files()
        for place, text in docstrings(path)
        for words in entries(text)
        if not words.endswith((".", ":")) or (words[0].islower() and not words.startswith(_NAMES))
    ]
    assert not wrong, "\n".join(wrong)
