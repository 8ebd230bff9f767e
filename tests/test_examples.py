"""The examples run, and show what they say."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from robot_adapters.adapter import IKStatus

FOLDER = Path(__file__).resolve().parents[1] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_policy_that_answers_in_torch_chunks_is_followed():
    assert set(example("wrap_policy").main()) == {IKStatus.REACHED}


def test_a_simulated_arm_is_driven_along_a_circle():
    pytest.importorskip("mujoco")
    command, tool = example("drive_simulated_arm").main(seconds=2.0)
    assert command < 1e-3
    assert 1e-3 < tool < 0.05  # it lags, and is there


def test_a_solver_of_ones_own_is_known_by_its_name():
    assert example("new_solver").main() < 1e-4


def test_lerobots_phone_pipeline_runs_with_mimicik():
    assert set(example("phone_pipeline").main()) == {IKStatus.REACHED}


def test_the_pictures_undamped_solver_jumps_and_the_guided_one_does_not(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(FOLDER)  # it uses the example beside it
    picture = example("wrist_singularity")
    trajectory = picture.motion()
    moved = {name: picture.commands(solver, trajectory) for name, solver in picture.solvers().items()}
    undamped, guided = (picture.joint_steps(q).max() for q in moved.values())
    assert undamped > 0.5  # rad a frame: an emergency stop
    assert guided < 0.1
    picture.draw(moved, trajectory, tmp_path / "wrist.gif", frames=2)
    assert (tmp_path / "wrist.gif").stat().st_size > 1000


def test_every_example_is_tested():
    tested = Path(__file__).read_text()
    assert [path.stem for path in FOLDER.glob("*.py") if f'"{path.stem}"' not in tested] == []
