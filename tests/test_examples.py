"""The examples run, and show what they say."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

from robot_adapters.adapter import IKStatus
from robot_adapters.wrapping import wrap_checkpoint

FOLDER = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture
def example(monkeypatch):
    """A function from an example's name to its module; examples find those beside them, as when they are run."""
    monkeypatch.syspath_prepend(FOLDER)

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    return load


def test_a_policy_that_answers_in_torch_chunks_is_followed(example):
    assert set(example("wrap_policy").main()) == {IKStatus.REACHED}


def test_a_simulated_arm_is_driven_along_a_circle(example):
    pytest.importorskip("mujoco")
    command, tool = example("drive_simulated_arm").main(seconds=2.0)
    assert command < 1e-3
    assert 1e-3 < tool < 0.05  # it lags, and is there


def test_a_solver_of_ones_own_is_known_by_its_name(example):
    assert example("new_solver").main() < 1e-4


def test_lerobots_phone_pipeline_runs_with_mimicik(example):
    assert set(example("phone_pipeline").main()) == {IKStatus.REACHED}


def test_recordings_through_lerobots_replay_are_met_within_a_step(example):
    for row in example("replay_recordings").main(("panda",), frames=60):
        if row["robot"] == "mimicik_ee":
            assert row["mean_mm"] < 0.1
            assert row["largest_step_rad"] < 0.095


def test_a_small_computers_adapter_follows_a_circle(example):
    # Into an empty environment it is installed in test_wheel.py.
    assert set(example("small_computer").main("airbot_play", frames=20)) == {IKStatus.REACHED}


def test_a_policys_chunks_drive_the_arm_more_smoothly_where_they_are_foreseen(example, act_run, tmp_path):
    pytest.importorskip("mujoco")
    wrapped = wrap_checkpoint(str(act_run), None, tmp_path / "act_ee")
    alone, foreseen = example("rollout_look_ahead").main(wrapped, seconds=4.0).values()
    assert foreseen["commanded"] < alone["commanded"]
    assert foreseen["measured"] < 1.1 * alone["measured"]


def test_every_example_is_tested():
    tested = Path(__file__).read_text()
    assert [path.stem for path in FOLDER.glob("*.py") if f'"{path.stem}"' not in tested] == []
