"""The command lines of the subcommands: reading them, and small helpers for their values."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import get_type_hints

import draccus

from lerobot_mimicik.kinematics.names import did_you_mean

# Other spellings of an option and what it is called where the first does not exist: those of LeRobot's commands, which
# mean the same everywhere, and those of earlier versions, which are answered with a word.
_SAME = {
    "--dataset": ("--dataset.root", "--datasets"),
    "--dataset.root": ("--dataset", "--datasets"),
    "--datasets": ("--dataset", "--dataset.root"),
    "--policy": ("--policy.path",),
    "--policy.path": ("--checkpoint",),
}
_FORMER = {
    "--checkpoint": ("--policy.path",),
    "--dataset_root": ("--dataset", "--dataset.root"),
    "--mode": ("--modes",),
    "--out": ("--output",),
    "--output_dir": ("--output",),
    "--robot": ("--arm",),
    "--urdf": ("--arm",),
}


def parse[Config](config_class: type[Config], argv: Sequence[str], prog: str) -> Config:
    """The options on a command line.

    A switch may stand without `=true`, and dashes for underscores. One vocabulary holds in all commands: spellings of
    LeRobot's and of earlier versions are understood where they name an option of another name.

    Args:
        config_class: A dataclass whose fields are the options; those of a dataclass in it are `--outer.inner`.
        argv: The words after the command.
        prog: The command, for help and messages.

    Raises:
        ValueError: An option does not exist.
        SystemExit: With 0 after the help.
        draccus.utils.DraccusException: A value is not of its option's type.
    """
    argv = bare_switches(spelled(underscored(argv), config_class), config_class)
    for argument in argv:
        option, _, group = argument.partition("=")
        if option in ("--help", "-h"):
            from lerobot_mimicik.cli.help_text import help_text

            print(help_text(config_class, prog, group))
            raise SystemExit(0)
    known = [*_options(config_class), "--help", "-h", "--config_path"]
    for argument in argv:
        option = argument.partition("=")[0]
        if option.startswith("--") and option not in known:
            raise ValueError(
                f"there is no option {option}.{did_you_mean(option, known)} {prog} --help lists all."
            )
    return draccus.parse(config_class, args=list(argv), prog=prog)


def say_loading() -> None:
    """A sign of life on stderr before imports that take seconds; nothing where they are done."""
    if "torch" not in sys.modules:
        print("Loading torch and LeRobot ...", file=sys.stderr, flush=True)


def spelled(argv: Sequence[str], config_class: type) -> list[str]:
    """The command line with other spellings of options replaced by this command's, with a word about former ones."""
    known = set(_options(config_class))
    groups = {f"--{name}" for name, kind in get_type_hints(config_class).items() if is_dataclass(kind)}
    arguments = []
    for argument in argv:
        option, equals, value = argument.partition("=")
        if option not in known - groups:
            same = next((each for each in _SAME.get(option, ()) if each in known - groups), None)
            former = next((each for each in _FORMER.get(option, ()) if each in known - groups), None)
            if same is None and former is not None:
                print(f"{option} is now written {former}", file=sys.stderr)
            option = same or former or option
        arguments.append(f"{option}{equals}{value}")
    return arguments


def _options(config_class: type, above: str = "--") -> list[str]:
    """The options that a dataclass stands for, those of dataclasses in it too."""
    found = []
    for name, kind in get_type_hints(config_class).items():
        found.append(above + name)
        if is_dataclass(kind):
            found += _options(kind, f"{above}{name}.")  # type: ignore[arg-type]
    return found


def bare_switches(argv: Sequence[str], config_class: type) -> list[str]:
    """The command line with a bare `--switch` of a boolean option written out as `--switch=true`."""
    switches = {f"--{entry.name}" for entry in fields(config_class) if entry.type in (bool, "bool")}
    arguments = list(argv)
    expanded = []
    for index, argument in enumerate(arguments):
        following = arguments[index + 1] if index + 1 < len(arguments) else "--"
        bare = argument in switches and following.startswith("--")
        expanded.append(f"{argument}=true" if bare else argument)
    return expanded


def underscored(argv: Sequence[str]) -> list[str]:
    """The command line with options written `--like-this` written `--like_this`, as they are declared."""
    arguments = []
    for argument in argv:
        name, equals, value = argument.partition("=")
        arguments.append(
            f"--{name[2:].replace('-', '_')}{equals}{value}" if name.startswith("--") else argument
        )
    return arguments


def join_repeated(argv: Sequence[str], option: str) -> list[str]:
    """The command line with every occurrence of an option merged into one, values joined by commas."""
    rest: list[str] = []
    values: list[str] = []
    arguments = iter(argv)
    for argument in arguments:
        if argument == option:
            values.append(next(arguments, ""))
        elif argument.startswith(f"{option}="):
            values.append(argument.split("=", 1)[1])
        else:
            rest.append(argument)
    return [*rest, f"{option}={','.join(values)}"] if values else rest


def words(text: str) -> list[str]:
    """The parts of a comma-separated option."""
    return [word.strip() for word in text.split(",") if word.strip()]


def numbers(text: str, option: str) -> list[int]:
    """Numbers and ranges such as `0-9,12`.

    Raises:
        ValueError: If a part is neither; the message names the option.
    """
    found: list[int] = []
    for word in words(text):
        first, dash, last = word.partition("-")
        if not first.isdigit() or (dash and not last.isdigit()):
            raise ValueError(f"{option}: {word!r} is neither a number nor a range such as 0-9.")
        found += range(int(first), int(last if dash else first) + 1)
    return found


def decimals(text: str, option: str) -> tuple[float, ...]:
    """The decimal numbers of a comma-separated option.

    Raises:
        ValueError: If a part is no number; the message names the option.
    """
    try:
        return tuple(float(word) for word in words(text))
    except ValueError:
        raise ValueError(f"{option} takes numbers separated by commas, got {text!r}") from None
