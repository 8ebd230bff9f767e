"""The simulated clock runs what is due, in order, and time passes only in sleep."""

from __future__ import annotations

import time

import pytest

from robot_adapters.clock import PatientClock, SimulatedClock


def test_callbacks_run_in_order_of_time_and_of_scheduling():
    clock, seen = SimulatedClock(), []
    clock.every(0.02, lambda: seen.append(("a", round(clock.monotonic(), 6))))
    clock.every(0.03, lambda: seen.append(("b", round(clock.monotonic(), 6))))
    clock.sleep(0.06)
    assert seen == [("a", 0), ("b", 0), ("a", 0.02), ("b", 0.03), ("a", 0.04), ("a", 0.06), ("b", 0.06)]
    assert clock.monotonic() == 0.06


def test_periods_do_not_drift():
    clock, count = SimulatedClock(), []
    clock.every(0.004, lambda: count.append(1), delay=0.004)
    for _ in range(2000):
        clock.sleep(0.05)
    assert len(count) == 25_000


def test_a_cancelled_callback_runs_no_more():
    clock, seen = SimulatedClock(), []
    schedule = clock.every(0.01, lambda: seen.append(1))
    clock.sleep(0.025)
    schedule.cancel()
    clock.sleep(1.0)
    assert len(seen) == 3


def test_a_callback_must_not_sleep():
    clock = SimulatedClock()
    clock.every(0.01, lambda: clock.sleep(0.1))
    with pytest.raises(RuntimeError, match="must not sleep"):
        clock.sleep(0.02)
    with pytest.raises(ValueError, match="period"):
        clock.every(0.0, lambda: None)


def test_a_patient_clock_lets_little_time_pass_however_long_the_program_was_held_up():
    clock, seen = PatientClock(most=0.02), []
    clock.every(0.01, lambda: seen.append(clock.monotonic()), delay=0.01)
    time.sleep(0.05)
    clock.catch_up()
    assert seen == [0.01, 0.02]
    assert clock.monotonic() == 0.02


def test_a_patient_clock_is_never_ahead_of_the_computer():
    clock, began = PatientClock(), time.monotonic()
    for _ in range(20):
        time.sleep(0.001)
        clock.catch_up()
        assert 0 < clock.monotonic() <= time.monotonic() - began + 1e-3
