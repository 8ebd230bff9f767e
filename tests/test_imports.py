"""Who may import whom: the packages of the house, and the arrows that are allowed."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Each room and the rooms that it may import; what is imported for annotations only counts nowhere.
_FOUNDATION = {"kinematics", "guidance", "foresight"}
_POLICY = {"configuration", "batches", "policy", "inference", "checkpoints"}
_LEARNING = (
    _FOUNDATION
    | _POLICY
    | {"outputs", "wire", "solvers", "data", "evaluation", "serving", "publishing", "viewing"}
)
_DRIVER = {"clock", "can", "airbot"}
ALLOWED = {
    "outputs": set(),  # how commands treat folders that exist
    "kinematics": set(),
    "guidance": {"kinematics"},
    "foresight": {"kinematics", "guidance"},  # the learned step in numpy, and what it is told
    "configuration": {"kinematics"},
    "batches": {"kinematics", "configuration", "foresight"},
    "policy": {
        "kinematics",
        "configuration",
        "batches",
        "foresight",
        "publishing",
    },  # `push_to_hub` is a method of the policy
    "inference": {"kinematics", "policy"},
    "checkpoints": {"configuration", "policy"},
    "wire": set(),  # what a remote solver and its server share
    "solvers": _FOUNDATION | {"inference", "checkpoints", "wire"},
    "data": {"kinematics", "outputs"},
    "evaluation": _FOUNDATION | {"outputs", "configuration", "solvers", "data", "checkpoints"},
    "serving": {"kinematics", "wire", "solvers"},
    "viewing": _FOUNDATION | {"solvers", "data", "evaluation"},
    "publishing": {"kinematics", "configuration", "evaluation"},
    "cli": _LEARNING,
    "clock": set(),
    "adapters": _LEARNING | {"clock"},
    "can": {"kinematics", "clock"},
    "airbot": {"kinematics", "clock", "can"},
    "simulation": {"kinematics"} | _DRIVER,
    "robots": {"kinematics", "configuration", "adapters", "simulation"} | _DRIVER,
    "robots_cli": _LEARNING | {"cli", "adapters", "simulation", "robots"} | _DRIVER,
    "plugin": {"configuration", "robots"},
}

_CONFIGURATION = ("lerobot_mimicik.configuration_", "lerobot_mimicik.columns", "lerobot_mimicik.processor_")


def room(module: str) -> str:
    """The room of a module; a package's top level has the names that LeRobot asks for, or the adapters."""
    package, _, inside = module.partition(".")
    first, *deeper = inside.split(".")
    if package == "robot_adapters":
        if first in ("arm", "checks", "clock", "safety", "signals"):
            return "clock"
        own = first if deeper or (ROOT / package / first).is_dir() else "adapters"
        return {"cli": "robots_cli", "": "adapters"}.get(own, own)
    if module.startswith(_CONFIGURATION) or ".baselines.configuration_" in module:
        return "configuration"
    return first if first in ALLOWED else "policy"


def modules() -> dict[str, Path]:
    """Every module by its name."""
    found = {}
    for package in ("lerobot_mimicik", "robot_adapters"):
        for path in sorted((ROOT / package).rglob("*.py")):
            found[".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")] = path
    return found


def imports(path: Path) -> Iterator[str]:
    """What a file imports at run time, inside functions too."""
    waiting: list[ast.AST] = [ast.parse(path.read_text())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            waiting += node.orelse
            continue
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        waiting += ast.iter_child_nodes(node)


@functools.cache
def arrows() -> set[tuple[str, str]]:
    """Importing and imported module, for every import within the house."""
    names, found = modules(), set()
    for module, path in names.items():
        for name in imports(path):
            # `from package.module import name` names the module, unless `name` is one itself.
            target = name if name in names else name.rpartition(".")[0]
            if target in names and target != module:
                found.add((module, target))
    return found


def test_every_import_is_an_arrow_of_the_table():
    forbidden = {
        (module, target)
        for module, target in arrows()
        if room(module) != room(target) and room(target) not in ALLOWED[room(module)]
    }
    assert not forbidden, "\n".join(
        f"{a} ({room(a)}) must not import {b} ({room(b)})" for a, b in sorted(forbidden)
    )


def test_the_learned_side_never_imports_the_robots():
    assert not [
        (module, target)
        for module, target in arrows()
        if module.startswith("lerobot_mimicik") and target.startswith("robot_adapters")
    ]


def test_no_modules_import_each_other_in_a_circle():
    ahead: dict[str, set[str]] = {}
    for module, target in arrows():
        ahead.setdefault(module, set()).add(target)
    while leaves := [module for module, targets in ahead.items() if not targets & ahead.keys()]:
        for leaf in leaves:
            del ahead[leaf]
    assert not ahead, f"among these: {sorted(ahead)}"
