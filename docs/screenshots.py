"""The pictures of `tour.md`: what `demo`, `eval`, `play` and `doctor` look like, taken with a headless Chromium.

Run it with `uv run --extra play python docs/screenshots.py outputs/demo`, after `mimicik demo` has filled that folder.
Behind the folder may stand the names of the pictures that are wanted, else all are taken.
"""

from __future__ import annotations

import html
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from lerobot_mimicik.viewing.browser import Browser

DOCS = Path(__file__).resolve().parent
_SIZE = (960, 1080)  # px
_DOCTOR_SIZE = (960, 320)
_PLAY = ("--solvers=guided,least_squares,undamped", "--motion=Wrist singularity", "--tremor=1")
_COLOURS = 128  # of a picture: enough for pages, and a third of the bytes


def shoot(page: Path, picture: Path, size: tuple[int, int] = _SIZE) -> None:
    """Take the picture of a page as it opens in a window of this size [px]."""
    with Browser(page.resolve().as_uri(), *size) as browser:
        browser.wait_for_drawing(3.0)  # the animation shall have reached the singularity
        browser.picture(picture)
    _shrink(picture)


def demo(folder: Path) -> None:
    """The page that a demo ends with."""
    shoot(folder / "report.html", DOCS / "demo.png")


def evaluation(folder: Path) -> None:
    """The page of the demo's evaluation."""
    shoot(folder / "eval" / "report.html", DOCS / "eval.png")


def play(folder: Path) -> None:
    """The page to play with, at the wrist singularity."""
    _run("play", *_PLAY, f"--screenshot={DOCS / 'play.png'}")


def doctor(folder: Path) -> None:
    """What the doctor says about a simulated arm, as the terminal shows it."""
    command = ["doctor", "--interface=virtual"]
    text = html.escape(f"$ mimicik {' '.join(command)}\n{_run(*command)}")
    with TemporaryDirectory() as temporary:
        page = Path(temporary) / "terminal.html"
        page.write_text(
            '<meta charset="utf-8"><body style="background:#1b2733;color:#e8edf1;margin:16px">'
            f'<pre style="font:14px/1.5 DejaVu Sans Mono,monospace;white-space:pre-wrap">{text}</pre>'
        )
        shoot(page, DOCS / "doctor.png", _DOCTOR_SIZE)


PICTURES: dict[str, Callable[[Path], None]] = {
    "demo": demo,
    "eval": evaluation,
    "play": play,
    "doctor": doctor,
}


def main(folder: str, *names: str) -> None:
    """Take the pictures, all of them unless named."""
    for name in names or PICTURES:
        PICTURES[name](Path(folder))


def _run(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "lerobot_mimicik.cli.main", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"mimicik {' '.join(arguments)}:\n{done.stdout}")
    return done.stdout


def _shrink(picture: Path) -> None:
    with Image.open(picture) as image:
        small = image.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
    small.save(picture, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
