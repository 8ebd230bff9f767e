"""The interpreter's settings while arms run, and afterwards."""

import gc
import logging
import sys

from driver_cell import QUICK, SlowMotion

from robot_adapters.simulation.cell import SimulatedCell


def test_collections_are_short_while_any_arm_runs_and_usual_afterwards():
    usual, frozen = sys.getswitchinterval(), gc.get_freeze_count()
    with (
        SimulatedCell(SlowMotion(), settings=QUICK) as first,
        SimulatedCell(SlowMotion(), settings=QUICK) as second,
    ):
        first.arm.connect()
        second.arm.connect()
        assert sys.getswitchinterval() <= 0.001
        first.arm.close()
        first.arm.close()
        assert sys.getswitchinterval() <= 0.001
        assert gc.get_freeze_count() > frozen + 1000
    assert sys.getswitchinterval() == usual
    assert gc.get_freeze_count() <= frozen


def test_no_record_is_made_of_frames_where_everything_is_let_through(caplog):
    with caplog.at_level(logging.NOTSET), SimulatedCell() as cell:
        cell.arm.connect()
        cell.clock.sleep(0.1)
    assert not [record for record in caplog.records if record.name.startswith("can.bus")]
