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


@pytest.mark.timeout(600)
def test_a_small_computer_answers_from_an_exported_file_without_torch_and_lerobot(wheel, tmp_path):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    from lerobot_mimicik.configuration_mimicik import MimicIKConfig
    from lerobot_mimicik.inference.onnx_export import write
    from lerobot_mimicik.modeling_mimicik import MimicIKPolicy

    file = tmp_path / "arm.onnx"
    write(MimicIKPolicy(MimicIKConfig(d_model=16, n_layers=1, n_heads=2, d_ff=16, device="cpu")).eval(), file)
    home, examples = tmp_path / "small", ROOT / "examples"
    venv.create(home, symlinks=True)
    python = str(home / "bin" / "python")
    run(UV, "pip", "install", "-q", "--no-deps", f"--python={python}", str(wheel), cwd=tmp_path)
    run(
        UV,
        "pip",
        "install",
        "-q",
        f"--python={python}",
        "-r",
        str(examples / "small_computer.txt"),
        cwd=tmp_path,
    )
    script = shutil.copy(examples / "small_computer.py", tmp_path)
    # Compiling takes longer than these few frames take in plain Python.
    use = f"import runpy, sys; main = runpy.run_path({str(script)!r})['main']"
    use += f"; assert set(main({str(file)!r}, 3)) == {{'reached'}}; assert not {{'torch', 'lerobot'}} & set(sys.modules)"
    done = subprocess.run(
        [python, "-I", "-c", use],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "3 of 3 targets reached" in done.stdout
    size = sum(path.stat().st_size for path in home.rglob("*") if path.is_file() and not path.is_symlink())
    assert size < 500e6  # as docs/small_computers.md says
