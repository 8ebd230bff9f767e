"""The wheel, installed into an empty environment: all that the tree has is in it, and it works from there."""

from __future__ import annotations

import os
import shutil
import site
import subprocess
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Where a wheel has what stands elsewhere in the tree.
MOVED = {"robot_adapters/plugin": "lerobot_policy_mimicik", "configs": "lerobot_mimicik/configs"}
UV = os.environ.get("UV") or shutil.which("uv")

USE = """
from pathlib import Path
import lerobot_policy_mimicik, lerobot_mimicik, robot_adapters
from lerobot.configs.policies import PreTrainedConfig
from lerobot.robots.config import RobotConfig
from lerobot_mimicik.evaluation.training_process import find_recipe
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
assert {"mimicik", "mimicik_mlp", "mimicik_unet"} <= set(PreTrainedConfig.get_known_choices())
assert "airbot_play_ee" in RobotConfig.get_known_choices()
assert all(len(describe_arm(name).joints()) >= 5 for name in SHIPPED_ARMS)
print(find_recipe("paper.json"))
for package in (lerobot_policy_mimicik, lerobot_mimicik, robot_adapters):
    print(package.__file__)
"""


def run(*command: str, cwd: Path) -> str:
    """What a command prints. AssertionError with its errors if it fails."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel of this tree, built from a copy, so that nothing is left in it."""
    if UV is None:
        pytest.skip("needs uv, which builds and installs the wheel")
    source = tmp_path_factory.mktemp("source")
    for name in ("lerobot_mimicik", "robot_adapters", "configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    run(UV, "build", "--wheel", "--quiet", "--out-dir=out", cwd=source)
    (found,) = (source / "out").glob("*.whl")
    return found


def test_all_modules_robots_and_recipes_of_the_tree_are_in_the_wheel(wheel):
    present = set(zipfile.ZipFile(wheel).namelist())
    for folder in ("lerobot_mimicik", "robot_adapters", "configs"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix not in (".py", ".urdf", ".json"):
                continue
            inside = path.relative_to(ROOT).as_posix()
            for here, there in MOVED.items():
                inside = there + inside.removeprefix(here) if inside.startswith(f"{here}/") else inside
            assert inside in present


def test_an_empty_environment_with_the_wheel_has_plugin_command_robots_and_recipes(wheel, tmp_path):
    home = tmp_path / "environment"
    venv.create(home, symlinks=True)
    python = home / "bin" / "python"
    run(UV, "pip", "install", "--quiet", "--no-deps", f"--python={python}", str(wheel), cwd=tmp_path)
    (packages,) = home.glob("lib/*/site-packages")
    # The libraries it depends on are those of this environment: a plain path behind the wheel's own files, so that
    # the hooks there, an editable checkout's among them, do not run.
    (packages / "libraries.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    files = run(str(python), "-I", "-c", USE, cwd=tmp_path).split()
    assert len(files) == 4
    assert all(Path(path).is_relative_to(packages) for path in files)
    shown = run(str(home / "bin" / "mimicik"), "--help", cwd=tmp_path)
    assert {"demo", "eval", "deploy"} <= set(shown.split())
