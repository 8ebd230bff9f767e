"""Energy from the counters of a machine, laid out as Linux does."""

import pytest
import torch

from lerobot_mimicik.evaluation.energy import EnergyMeter

pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU counts energy of its own")


def package(folder, name, microjoules, full=1_000_000):
    (folder / name).mkdir(parents=True)
    (folder / name / "energy_uj").write_text(f"{microjoules}\n")
    (folder / name / "max_energy_range_uj").write_text(f"{full}\n")


def count(folder, name, microjoules):
    (folder / name / "energy_uj").write_text(f"{microjoules}\n")


def test_packages_are_added_and_their_parts_are_not(tmp_path):
    for name, value in (("intel-rapl:0", 100), ("intel-rapl:1", 5), ("intel-rapl:0:0", 7)):
        package(tmp_path, name, value)
    meter = EnergyMeter(tmp_path)
    for name in ("intel-rapl:0", "intel-rapl:1", "intel-rapl:0:0"):
        count(tmp_path, name, 500_000)
    assert meter.joules() == pytest.approx(0.999895, abs=1e-9)


def test_a_counter_that_began_again_is_understood(tmp_path):
    package(tmp_path, "intel-rapl:0", 900_000)
    meter = EnergyMeter(tmp_path)
    count(tmp_path, "intel-rapl:0", 100_000)
    assert meter.joules() == pytest.approx(0.2)


def test_a_machine_that_does_not_tell_gives_none(tmp_path):
    assert EnergyMeter(tmp_path / "no-such-folder").joules() is None
