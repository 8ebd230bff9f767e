"""Paths that a user gives: whether they exist, said before anything heavy is imported, with what lies near.

Only the standard library is imported here.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path


def looks_like_path(text: str) -> bool:
    """Whether something that does not exist is meant as a path rather than as a Hub repository (user/name).

    It is where it starts as paths do, has more or less than one slash, or its first part is a folder here or is
    called nearly like one.
    """
    if text.startswith((".", "/", "~")) or text.count("/") != 1:
        return True
    parent = Path(text).parent
    return parent.is_dir() or bool(_similar(parent, 0.75))


def near(path: str | Path) -> str:
    """What exists where a path ends to exist, most similar names first: ` Near: outputs/run.`; or nothing."""
    missing = Path(path).expanduser()
    while not missing.parent.exists() and missing.parent != missing:
        missing = missing.parent
    found = _similar(missing) or _siblings(missing)
    return f" Near: {', '.join(found[:5])}." if found else ""


def check_dataset(root: str | Path, option: str) -> None:
    """Refuse a folder that is no LeRobot dataset.

    Raises:
        FileNotFoundError: It names the option, the folder and the datasets near it.
    """
    root = Path(root).expanduser()
    if (root / "meta" / "info.json").is_file():
        return
    nearby = sorted(
        {str(file.parents[1]) for base in (root, root.parent) for file in base.glob("*/meta/info.json")}
    )
    hint = f" Datasets nearby: {', '.join(nearby)}." if nearby else near(root) if not root.exists() else ""
    raise FileNotFoundError(
        f"{option}: {root} is not a LeRobot dataset: {root / 'meta/info.json'} does not exist.{hint}"
    )


def check_exists(path: str | Path, option: str) -> None:
    """Refuse a file or folder that is not there.

    Raises:
        FileNotFoundError: It names the option, the path and what lies near.
    """
    if not Path(path).expanduser().exists():
        raise FileNotFoundError(f"{option}: {path} does not exist.{near(path)}")


def _siblings(path: Path) -> list[str]:
    """Everything beside a path, but hidden files."""
    if not path.parent.is_dir():
        return []
    return sorted(str(each) for each in path.parent.iterdir() if not each.name.startswith("."))


def _similar(path: Path, alike: float = 0.6) -> list[str]:
    """What lies beside a path and is called nearly like it; `alike` is difflib's ratio, 1 for the same name."""
    beside = _siblings(path)
    names = difflib.get_close_matches(path.name, [Path(each).name for each in beside], n=5, cutoff=alike)
    return [str(path.parent / name) for name in names]


def datasets_in(folders: Sequence[Path]) -> tuple[Path, ...]:
    """The folders that are datasets, and the datasets directly in those that are not."""
    roots: list[Path] = []
    for folder in folders:
        inside = sorted(info.parent.parent for info in folder.glob("*/meta/info.json"))
        roots += [folder] if (folder / "meta" / "info.json").is_file() or not inside else inside
    return tuple(roots)
