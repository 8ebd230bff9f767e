"""What this project may replace or delete: only folders that it marked, and in them only files that it writes.

Every folder that a command fills gets a mark first, a small file `.mimicik.json` that says what the folder holds:

    {"kind": "dataset", "version": 1}

A file is ours if the nearest marked folder above it is of a kind that has such a file (`_FILES`). Everything else is
somebody's, and no command touches it: it stops and names the file. There is no other way to delete a folder here.

A folder that was made before there were marks, or that lost its mark, is not replaced either; the message says how
its owner can mark it. A single file that a command writes where the user says is replaced only where its beginning
shows that this project wrote it (`check_file`).

Two runs never write to one place at a time: a run holds its output (`alone`) for as long as its process lives.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path

try:
    import fcntl
except ModuleNotFoundError:  # on Windows, where nothing is held
    fcntl = None  # type: ignore[assignment]

MARK_FILE = ".mimicik.json"
PICTURE_MARK = b"made by mimicik demo"
"""The comment in the pictures that `mimicik demo` may write again."""
_VERSION = 1
_HEAD = 4096  # bytes at the beginning of a file in which its mark is looked for
_FIGURES = ("figures/*.png", "figures/*.gif", "figures/*.txt")
_CHECKPOINTS = ("checkpoints/last", "checkpoints/*/*/*.safetensors", "checkpoints/*/*/*.json")
# Files of each kind of folder, below it. A folder below that has a mark of its own is judged by that one.
_FILES: dict[str, tuple[str, ...]] = {
    "dataset": (
        "data/chunk-*/file-*.parquet",
        "meta/episodes/chunk-*/file-*.parquet",
        "meta/tasks.parquet",
        *(f"meta/{name}.json" for name in ("info", "stats", "arm", "joint_log", "retarget_report")),
    ),
    # A folder that is being filled, and the one it will replace.
    "writing": (),
    "parts": ("manifest.json", "part-*.npz", "part-*.tmp"),
    "demo": (
        "demo.json",
        "report.html",
        "data/summary.txt",
        *_FIGURES,
        "logs/train-*.log",
        *(f"train/{name}" for name in _CHECKPOINTS),
    ),
    "benchmark": (
        *("summary.json", "summary.tmp", "table.json", "table.md", "report.html", "arm.urdf"),
        *_FIGURES,
        "anatomy/*.npz",
        "train/*/arguments.json",
        "train/*/logs/train-*.log",
        *(f"train/*/run/{name}" for name in _CHECKPOINTS),
    ),
    "report": ("report.json", "report.md", "report.html", "deployment.json", *_FIGURES),
}


def check_new(
    folder: str | Path, kind: str, overwrite: bool = False, inputs: Iterable[str | Path] = ()
) -> None:
    """See that `folder` can be made new: it is not there, it is empty, or it may be replaced.

    Args:
        folder: What shall be made.
        kind: What it shall hold, a key of `_FILES`.
        overwrite: Whether a folder that is marked as of this kind, and holds nothing else, may be replaced.
        inputs: Files and folders that are read to make it.

    Raises:
        FileExistsError: There is something that may not be replaced; names it, and the remedy.
        ValueError: An input lies in the folder, or the folder in an input.
    """
    folder = Path(folder)
    check_apart(folder, inputs)
    if not folder.exists():
        return
    if not folder.is_dir():
        raise FileExistsError(f"{folder} exists already and is a file; choose another folder")
    if not any(folder.iterdir()):
        return
    if not overwrite:
        raise FileExistsError(
            f"{folder} exists already; choose another folder, or replace it with --overwrite"
        )
    if kind_of(folder) != kind:
        raise FileExistsError(_unmarked(folder, kind))
    _check_ours(folder)


def check_apart(folder: str | Path, inputs: Iterable[str | Path]) -> None:
    """See that neither an input lies in an output folder nor the folder in an input, links followed.

    Raises:
        ValueError: One does.
    """
    output = Path(folder).resolve()
    for given in inputs:
        source = Path(given).resolve()
        if source == output:
            raise ValueError(f"the input {given} is also the output; write to another folder")
        if output in source.parents:
            raise ValueError(f"the input {given} lies in the output {folder}; write to another folder")
        if source in output.parents:
            raise ValueError(f"the output {folder} lies in the input {given}; write to another folder")


def claim(folder: str | Path, kind: str) -> None:
    """See that files of `kind` can be written into `folder`, beside whatever it holds, and mark it.

    A folder of this kind is gone on with: its files may be replaced. In any other folder none of them may exist.

    Raises:
        FileExistsError: A file would be replaced that this project did not write, or not as this kind.
    """
    folder = Path(folder)
    found = kind_of(folder)
    if found == kind:
        return
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder} exists already and is a file; choose another folder")
    for pattern in _FILES[kind]:
        if (there := next(folder.glob(pattern), None)) is not None:
            raise FileExistsError(_unmarked(folder, kind, f"{there} would be replaced, but "))
    folder.mkdir(parents=True, exist_ok=True)
    if found is None:
        mark(folder, kind)


def check_file(path: str | Path, option: str, mark: bytes = b"") -> None:
    """See that a single file can be written: it is not there, or this project wrote it.

    Args:
        path: The file; the folders above it are made.
        option: What names it on the command line, for the message.
        mark: Bytes that stand near the beginning of what is written there; empty: no file is replaced.

    Raises:
        FileExistsError: There is something else.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() and not path.is_symlink():
        return
    if mark and path.is_file():
        with path.open("rb") as file:
            if mark in file.read(_HEAD):
                return
    why = "this command did not write it" if mark else "it may be needed"
    raise FileExistsError(
        f"{option}: {path} exists already and is not replaced, for {why}; name another, or remove it"
    )


@contextmanager
def alone(output: str | Path) -> Iterator[None]:
    """Hold an output, so that no other run writes to it at the same time.

    The lock ends with the process, however that ends; the empty file OUTPUT.lock that a killed one leaves locks
    nobody out. Where the folder above may not be written to, nothing is held.

    Raises:
        FileExistsError: Another run holds it.
    """
    path = Path(output).resolve()
    lock = path.with_name(path.name + ".lock")
    made = [parent for parent in lock.parents if not parent.exists()]
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        file = _locked(lock, output)
    except PermissionError:
        file = None
    try:
        yield
    finally:
        if file is not None:
            # Only what is ours: somebody's own OUTPUT.lock has content.
            if not os.fstat(file).st_size:
                lock.unlink(missing_ok=True)
            os.close(file)
        for parent in made:  # the innermost first; it stays where anything was written to it
            with suppress(OSError):
                parent.rmdir()


def _locked(lock: Path, output: str | Path) -> int | None:
    """The open and locked lock file."""
    if fcntl is None:
        return None
    while True:
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Who held it may have removed it between these two lines: then it locks nobody out.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.stat(lock), os.fstat(file)):
                    return file
        except BlockingIOError:
            os.close(file)
            raise FileExistsError(
                f"another run is writing to {output} ({lock} is held by it): wait for it, or choose another output"
            ) from None
        except OSError:  # a file system without locks
            os.close(file)
            return None
        os.close(file)


def mark(folder: Path, kind: str) -> None:
    """Make `folder`, unless it exists, and say that it is one of this project's: do this before anything else."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK_FILE).write_text(_mark(kind) + "\n")


def kind_of(folder: Path) -> str | None:
    """What the mark of a folder says that it holds; None without a mark that is known."""
    try:
        found = json.loads((folder / MARK_FILE).read_text())
    except (OSError, ValueError):
        return None
    known = isinstance(found, dict) and found.get("version") == _VERSION and found.get("kind") in _FILES
    return str(found["kind"]) if known else None


def strangers(folder: Path) -> Iterator[Path]:
    """Files and links in a folder that are not this project's."""
    folder = folder.resolve()
    # Marks above the folder count: a run of training lies in the marked folder of a demo.
    above = next((parent for parent in (folder, *folder.parents) if kind_of(parent)), None)
    yield from _strangers(folder, above)


def remove(folder: str | Path) -> None:
    """Delete a folder of this project, or a part of one; nothing happens if it does not exist.

    Raises:
        FileExistsError: A file in it is not this project's; then nothing was deleted.
    """
    folder = Path(folder).resolve()
    if not folder.exists():
        return
    _check_ours(folder)
    for path, _, files in os.walk(folder, topdown=False):
        # The mark goes last: what an interruption leaves is still known as ours.
        for name in sorted(files, key=lambda name: name == MARK_FILE):
            (Path(path) / name).unlink()
        for entry in list(Path(path).iterdir()):
            if entry.is_symlink():  # to a folder, as LeRobot's checkpoints/last
                entry.unlink()
        Path(path).rmdir()


@contextmanager
def building(folder: str | Path, kind: str) -> Iterator[Path]:
    """A new marked folder to fill, which becomes `folder` at the end, in the place of what `check_new` allowed.

    It is filled in FOLDER.writing, so that FOLDER is at no time half of anything, whatever ends the process.

    Raises:
        FileExistsError: FOLDER.writing, or by now FOLDER, holds something that is not this project's.
    """
    folder = Path(folder).resolve()
    beside = folder.with_name(folder.name + ".writing")
    with alone(beside):
        check_new(beside, "writing", overwrite=True)
        remove(beside)
        mark(beside, "writing")
        new, old = beside / "new", beside / "old"
        mark(new, kind)
        try:
            yield new
            if kind_of(folder) == kind:
                _check_ours(folder)
                os.replace(folder, old)
            elif folder.exists():
                folder.rmdir()  # it was empty when this began
            os.replace(new, folder)
        finally:
            remove(beside)


def _check_ours(folder: Path) -> None:
    stranger = next(strangers(folder), None)
    if stranger is not None:
        raise FileExistsError(
            f"{folder} is not replaced: {stranger} was not made by this project. Move it away, or choose another folder"
        )


def _strangers(folder: Path, above: Path | None) -> Iterator[Path]:
    marked = folder if kind_of(folder) else above
    for entry in sorted(folder.iterdir()):
        if entry.is_dir() and not entry.is_symlink():
            yield from _strangers(entry, marked)
        elif marked is None or not _known(entry.relative_to(marked).parts, kind_of(marked) or ""):
            yield entry


def _known(parts: tuple[str, ...], kind: str) -> bool:
    """Whether folders of a kind have such a file."""
    return any(_matches(parts, tuple(pattern.split("/"))) for pattern in (MARK_FILE, *_FILES[kind]))


def _matches(parts: tuple[str, ...], pattern: tuple[str, ...]) -> bool:
    return len(parts) == len(pattern) and all(map(fnmatchcase, parts, pattern))


def _mark(kind: str) -> str:
    return json.dumps({"kind": kind, "version": _VERSION})


def _unmarked(folder: Path, kind: str, what: str = "") -> str:
    return (
        f"{what}{folder} is not marked as a {kind} of this project (it has no {MARK_FILE} that says so), so nothing in "
        "it is replaced. Choose another folder, or remove it yourself. If an earlier version made it, this mark "
        f"allows replacing it: echo '{_mark(kind)}' > {folder / MARK_FILE}"
    )
