"""Fixtures of the whole suite."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples on every run, and no verdict that depends on how busy the machine is.
settings.register_profile("suite", derandomize=True, deadline=None, database=None)
settings.load_profile("suite")

_SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """A function from a name below `../shared/data` (beside the repository) to its path.

    The recordings there may not be redistributed, so most checkouts lack them: the test that asks is then
    skipped.
    """

    def path_of(name: str) -> Path:
        path = _SHARED_DATA / name
        if not path.exists():
            pytest.skip(
                f"needs the recording {name!r}, which is not part of the repository: {path} does not exist"
            )
        return path

    return path_of


@pytest.fixture(scope="session")
def mimicik_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training run of a small MimicIK policy of the AIRBOT Play, its data beside it in `data`."""
    from trained import train_mimicik

    return train_mimicik(tmp_path_factory.mktemp("mimicik"))


@pytest.fixture(scope="session")
def act_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training run of a small ACT policy in end-effector space, its data beside it in `ee`."""
    from trained import train_act

    return train_act(tmp_path_factory.mktemp("act"))
