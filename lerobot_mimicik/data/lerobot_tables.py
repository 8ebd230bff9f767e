"""LeRobot v3 datasets read as tables: without LeRobot, which takes seconds to import and a frame at a time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_mimicik.data.tables import read_parquet

if TYPE_CHECKING:
    import pandas as pd

STATE = "observation.state"


def is_lerobot(source: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (source / "meta" / "info.json").is_file()


def read_lerobot(root: Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    """All frames of a dataset but their images, one column a feature, and its `meta/info.json`.

    Raises:
        ValueError: Files that are missing or cannot be read.
    """
    import pandas as pd

    try:
        info = json.loads((root / "meta" / "info.json").read_text())
    except ValueError as error:
        raise ValueError(f"{root / 'meta' / 'info.json'} is not JSON: {error}") from error
    wanted = [key for key, feature in info["features"].items() if feature["dtype"] not in ("video", "image")]
    files = sorted((root / "data").glob("*/*.parquet"))
    if not files:
        raise ValueError(f"LeRobot dataset {root} has no data/*/*.parquet")
    return pd.concat([read_parquet(path, columns=wanted) for path in files], ignore_index=True), info


def joint_table(root: Path) -> pd.DataFrame:
    """A dataset with one column for each named number: those of the state by their names, others as `action.NAME`.

    Raises:
        ValueError: As `read_lerobot`, or a state without names.
    """
    import pandas as pd

    table, info = read_lerobot(root)
    columns = {}
    for key, feature in info["features"].items():
        names = component_names(info, key)
        if key not in table or feature["dtype"] == "string":
            continue
        if not names:
            if feature["shape"] == [1]:
                columns[key] = table[key].to_numpy()
            continue
        numbers = np.stack(table[key].to_numpy()).reshape(len(table), -1)
        for index, name in enumerate(names):
            columns[name if key == STATE else f"{key}.{name}"] = numbers[:, index]
    if not component_names(info, STATE):
        raise ValueError(f"LeRobot dataset {root} names no numbers of a {STATE}: which are joints?")
    tasks = task_sentences(root)
    if "task_index" in columns:
        columns["task"] = np.array([tasks.get(int(index), "") for index in columns["task_index"]])
    return pd.DataFrame(columns)


def component_names(info: dict[str, Any], key: str) -> list[str]:
    """Names of a feature's numbers, as far as the dataset gives them."""
    names = info["features"].get(key, {}).get("names") or []
    return [str(name) for name in (next(iter(names.values())) if isinstance(names, dict) else names)]


def task_sentences(root: Path) -> dict[int, str]:
    """Tasks by their index, as far as the dataset states them."""
    if not (root / "meta" / "tasks.parquet").is_file():
        return {}
    table = read_parquet(root / "meta" / "tasks.parquet")
    return {int(index): str(task) for task, index in table["task_index"].items()}
