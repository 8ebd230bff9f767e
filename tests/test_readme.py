"""The README and docs/ hold: their Python runs as it stands, their links resolve, their options exist, they are short."""

from __future__ import annotations

import importlib
import re
import shlex
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "configs/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
# A page whose Python is the outline of a file to be written.
_OUTLINE = "solvers.md"


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page in a language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=named)
def test_python_runs_as_it_stands(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks(page, "python"):
        code = compile(block, page.name, "exec")
        if page.name != _OUTLINE:
            exec(code, names)


def test_the_readme_is_read_in_five_minutes():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def test_ci_runs_the_readmes_test_command():
    command = "uv run pytest"
    assert any(command in block for block in blocks(ROOT / "README.md", "bash"))
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


def test_the_citation_names_this_version():
    version = re.search(r'^version = "(.+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert version is not None
    assert f"version: {version[1]}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_relative_links_resolve(page):
    links = re.findall(r"!?\[[^\]]*\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    local = [link.partition("#")[0] for link in links if not re.match(r"[a-z]+:", link)]
    assert [link for link in local if link and not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_files_that_are_named_exist(page):
    text = page.read_text(encoding="utf-8")
    paths = re.findall(r"`((?:docs|examples|configs|tests|lerobot_mimicik|robot_adapters)/[\w/.]*)`", text)
    paths += re.findall(r"(?:python|--config_path=) ?((?:examples|configs)/\S+\.\w+)", text)
    assert [path for path in paths if not (ROOT / path).exists()] == []


def commands(page: Path) -> Iterator[list[str]]:
    """Every call of `mimicik` or one of LeRobot's commands in a page's shell blocks, and of `mimicik` in inline code."""
    text = page.read_text(encoding="utf-8")
    shell = "\n".join(blocks(page, "bash")).replace("\\\n", " ")
    for line in [*shell.splitlines(), *re.findall(r"`((?:uv run )?mimicik [^`]+)`", text)]:
        words = shlex.split(line, comments=True)
        for start, word in enumerate(words):
            if word == "mimicik" or word.startswith("lerobot-"):
                yield words[start:]
                break


def has_option(config: type, option: str) -> bool:
    """Whether a command's configuration has an option such as `policy.path`."""
    name, _, rest = option.partition(".")
    hints = get_type_hints(config)
    if name not in {entry.name for entry in fields(config)}:
        return False
    return not rest or not is_dataclass(hints[name]) or has_option(hints[name], rest)


def configuration(command: str) -> type:
    """The dataclass of the options of a subcommand."""
    for package in ("lerobot_mimicik.cli", "robot_adapters.cli"):
        path = ROOT / package.replace(".", "/") / f"{command.replace('-', '_')}.py"
        if path.is_file():
            module = importlib.import_module(f"{package}.{path.stem}")
            (name,) = set(re.findall(r"\bparse\((\w+Config)", path.read_text()))
            return getattr(module, name)
    raise AssertionError(f"there is no command mimicik {command}")


def is_robots_option(option: str) -> bool:
    """Whether one of the robots here has an option, or, behind `arm.`, any robot that may be inside."""
    import lerobot.scripts.lerobot_replay  # noqa: F401 - knows LeRobot's robots

    from robot_adapters.robots.config_airbot_play import AirbotPlayEEConfig, BiAirbotPlayEEConfig
    from robot_adapters.robots.config_mimicik_ee import JointRobot, MimicIKEEConfig
    from robot_adapters.robots.config_mimicik_sim import MimicIKSimConfig

    own = (AirbotPlayEEConfig, BiAirbotPlayEEConfig, MimicIKEEConfig, MimicIKSimConfig)
    if option.startswith("arm."):
        option, own = option.removeprefix("arm."), tuple(JointRobot.get_known_choices().values())
    return any(has_option(config, option) for config in own)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_options_that_are_named_exist(page):
    import lerobot.policies  # noqa: F401 - knows LeRobot's policies
    from lerobot.configs import PreTrainedConfig

    import lerobot_mimicik.configuration_mimicik  # noqa: F401 - and these ours

    missing = []
    for program, *words in commands(page):
        options = [word[2:].partition("=")[0].replace("-", "_") for word in words if word.startswith("--")]
        if program == "mimicik" and words and not words[0].startswith("-"):
            config = configuration(words[0])
            if words[0] == "calibrate":  # whose robot is LeRobot's
                options = [option for option in options if not option.startswith("robot.")]
            options = [option for option in options if option not in ("help", "arm", "robot")]
            missing += [f"{words[0]} --{option}" for option in options if not has_option(config, option)]
        else:  # LeRobot's own options are LeRobot's; ours are those of policy and robot
            types = [word.partition("=")[2] for word in words if word.startswith("--policy.type=")]
            policy = PreTrainedConfig.get_choice_class((types or ["mimicik"])[0])
            for option in options:
                kind, _, rest = option.partition(".")
                if kind == "policy" and rest not in ("path", "type", "push_to_hub", "repo_id"):
                    missing += [] if has_option(policy, rest) else [option]
                if kind == "robot" and rest not in ("type", "arm.type"):
                    missing += [] if is_robots_option(rest) else [option]
    assert missing == []
