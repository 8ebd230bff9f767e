"""Where the real AIRBOT Play logs lie that some tests compare with; they are not part of the project."""

from __future__ import annotations

import os
from pathlib import Path


def airbot_data(name: str) -> Path | None:
    """The file `name` of the folder `airbot_play_real` under $MIMICIK_DATA or a `shared/data` beside the project.

    None where there is no such file: the tests that need it skip.
    """
    root = Path(__file__).resolve().parents[1]
    folders = [Path(os.environ["MIMICIK_DATA"])] if "MIMICIK_DATA" in os.environ else []
    folders += [root / "shared" / "data", root.parent / "shared" / "data"]
    for folder in folders:
        path = folder / "airbot_play_real" / name
        if path.is_file():
            return path
    return None
