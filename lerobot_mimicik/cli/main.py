"""The `mimicik` console script: finds the subcommand's module and hands it the rest of the command line.

A subcommand is a module with `HELP`, one line on what it does, and `main(argv)`; its name is the module's
with dashes. Modules lie in the packages of the entry-point group `mimicik.commands` (this one, and that of
the robot adapters, which this side never imports by name). They are imported only when their command runs; the
lines of `mimicik --help` are read from their source text.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path

from lerobot_mimicik.kinematics.names import did_you_mean

_GROUP = "mimicik.commands"
_TRACEBACK = "MIMICIK_TRACEBACK"
# Libraries that read options and files, and whose own errors are about those.
_READERS = ("draccus", "safetensors", "pyarrow", "yaml")


def subcommands() -> dict[str, str]:
    """Each subcommand and what it does, in alphabetical order, without importing any."""
    return {name: text for name, (_, text) in sorted(_found().items())}


def _found() -> dict[str, tuple[str, str]]:
    """Each subcommand's module and help line."""
    found = {}
    for package in dict.fromkeys(entry.value for entry in entry_points(group=_GROUP)):
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            for path in Path(folder).glob("*.py"):
                text = _help_of(path)
                if text is not None:
                    found[path.stem.replace("_", "-")] = (f"{package}.{path.stem}", text)
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand; returns the exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    known = subcommands()
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        _say(_overview(known))
        return 0
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("lerobot_policy_mimicik"))
        return 0
    command, *rest = arguments
    if command not in known:
        print(
            f"mimicik: unknown command {command!r}; known are {', '.join(known)}.{did_you_mean(command, known)}",
            file=sys.stderr,
        )
        return 2
    module = importlib.import_module(_found()[command][0])
    try:
        return int(module.main(rest) or 0)
    except Exception as error:
        # A user's error says what to change; where it was raised is of use to developers only.
        if os.environ.get(_TRACEBACK) or not _is_the_users(error):
            raise
        print(f"mimicik {command}: {_reason_of(error)}", file=sys.stderr)
        print(f"({_TRACEBACK}=1 shows where this comes from.)", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"\nmimicik {command}: interrupted.", file=sys.stderr)
        return 130


def _is_the_users(error: Exception) -> bool:
    """Whether options or files are to blame rather than this program, as far as the error's kind tells."""
    library = type(error).__module__.partition(".")[0]
    return isinstance(error, ValueError | OSError | RuntimeError | MemoryError) or library in _READERS


def _reason_of(error: Exception) -> str:
    """An error's text; draccus says only in the error's cause why it refuses a value."""
    text = str(error) or type(error).__name__
    if type(error).__module__.startswith("draccus.") and isinstance(error.__cause__, TypeError | ValueError):
        text = f"{text} {error.__cause__}"
    return text


def _say(text: str) -> None:
    """Print, without complaint where the reader (head, less) has enough."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _help_of(path: Path) -> str | None:
    """The string that a module assigns to HELP at its top level, or None."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == "HELP" for target in targets):
            value = node.value  # type: ignore[attr-defined]
            return str(ast.literal_eval(value))
    return None


def _overview(known: dict[str, str]) -> str:
    width = max((len(name) for name in known), default=0)
    lines = [f"  {name:<{width}}  {text}" for name, text in known.items()]
    return "\n".join(
        [
            "usage: mimicik COMMAND [options]",
            "",
            "Inverse kinematics learned from teleoperation. A policy is trained with LeRobot's own command:",
            "  lerobot-train --policy.type=mimicik --dataset.repo_id=... (see configs/)",
            "",
            "commands:",
            *lines,
            "",
            "mimicik COMMAND --help shows a command's options.",
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
