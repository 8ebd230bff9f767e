"""Paths that do not exist are named at once, with what lies near, and are not asked of the Hub."""

import subprocess
import sys

import pytest

from lerobot_mimicik.checkpoints import find_checkpoint
from lerobot_mimicik.inputs import check_dataset, check_exists

COMMANDS = [
    "eval --dataset.root=outputs/nope",
    "eval --dataset.root=outputs/data --policy.path=outputs/rnu",
    "eval --dataset.root=outputs/data --device=gpu",
    "bench --datasets=outputs/nope --train=outputs/data",
    "bench --datasets=outputs/data --train=outputs/nope",
    "bench --datasets=outputs/data --train=outputs/data --arm=nope.urdf",
    "serve --policy.path=outputs/rnu",
    "serve --arm=nope.urdf",
    "deploy --policy.path=outputs/rnu",
    "deploy --policy.path=outputs/run --dataset.root=outputs/nope",
    "wrap --policy.path=outputs/rnu --output=outputs/new",
    "wrap --policy.path=outputs/run --ik.path=outputs/rnu --output=outputs/new",
    "make-dataset --source=ee --input=outputs/nope --output=outputs/new",
    "make-dataset --source=joints --input=outputs/nope --output=outputs/new",
    "make-dataset --source=synthetic --episodes=1 --arm=nope.urdf --output=outputs/new",
    "demo --arm=nope.urdf --output=outputs/new",
    "demo --source=ee --input=outputs/nope --output=outputs/new",
]
_RUN = """
import sys
from lerobot_mimicik.cli import main
for line in sys.stdin:
    status = main.main(line.split())
    print(status, sorted({"torch", "lerobot"} & set(sys.modules)), file=sys.stderr)
"""


@pytest.fixture
def outputs(tmp_path, monkeypatch):
    """A folder with a dataset and a checkpoint, as far as a glance tells; the working directory is above it."""
    for file in ("data/meta/info.json", "run/config.json"):
        (tmp_path / "outputs" / file).parent.mkdir(parents=True)
        (tmp_path / "outputs" / file).write_text("{}")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "outputs"


def test_every_command_names_a_wrong_path_without_importing_torch_or_lerobot(outputs):
    done = subprocess.run(
        [sys.executable, "-c", _RUN], input="\n".join(COMMANDS), capture_output=True, text=True, check=True
    )
    lines = [line for line in done.stderr.splitlines() if not line.startswith("(")]
    assert len(lines) == 2 * len(COMMANDS), done.stderr
    for command, error, status in zip(COMMANDS, lines[::2], lines[1::2], strict=True):
        assert status in ("1 []", "2 []"), f"{command}: {error} {status}"
        assert error.startswith(f"mimicik {command.split()[0]}: ")
        assert any(name in error for name in ("outputs/nope", "outputs/rnu", "nope.urdf", "'gpu'")), error


@pytest.mark.parametrize(
    "path", ["outputs/rnu", "./run", "output/run", "outputs/a/b", "rum", "~/nope-at-all/x"]
)
def test_what_looks_like_a_path_is_not_asked_of_the_hub(outputs, path):
    with pytest.raises(FileNotFoundError, match=rf"{path} does not exist"):
        find_checkpoint(path)


def test_a_repository_is_left_to_the_hub(outputs):
    assert find_checkpoint("user/mimicik-airbot") == "user/mimicik-airbot"


def test_what_lies_near_is_said(outputs):
    with pytest.raises(FileNotFoundError, match=r"Near: outputs/run\."):
        find_checkpoint("outputs/rnu")
    with pytest.raises(FileNotFoundError, match=r"Near: outputs\."):
        find_checkpoint("output/run")
    with pytest.raises(FileNotFoundError, match=r"Datasets nearby: outputs/data\."):
        check_dataset("outputs/dta", "--dataset.root")
    with pytest.raises(
        FileNotFoundError, match=r"--input: outputs/x does not exist\. Near: outputs/data, outputs/run"
    ):
        check_exists("outputs/x", "--input")
