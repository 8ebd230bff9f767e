"""Guards run before the handlers they find, in any order of coming and going."""

from __future__ import annotations

import os
import signal

import pytest

from robot_adapters.signals import SignalGuard


@pytest.fixture
def heard():
    """What was called on SIGTERM, with a handler of somebody else's at the bottom."""
    calls: list[str] = []
    before = signal.signal(signal.SIGTERM, lambda *_: calls.append("theirs"))
    yield calls
    signal.signal(signal.SIGTERM, before)


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


def test_guards_pass_on_and_leave_in_any_order(heard):
    first, second = SignalGuard(lambda: heard.append("first")), SignalGuard(lambda: heard.append("second"))
    theirs, interrupt = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    first.install()
    second.install()
    terminate()
    assert heard == ["second", "first", "theirs"]
    first.remove()
    terminate()
    assert heard[3:] == ["second", "theirs"]
    second.remove()
    terminate()
    assert heard[5:] == ["theirs"]
    first.remove()
    assert signal.getsignal(signal.SIGTERM) == theirs
    assert signal.getsignal(signal.SIGINT) == interrupt


def test_without_a_handler_of_others_the_process_is_asked_to_exit(heard):
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    guard = SignalGuard(lambda: heard.append("guard"))
    guard.install()
    with pytest.raises(SystemExit):
        terminate()
    guard.remove()
    assert heard == ["guard"]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_an_ignored_signal_stays_ignored(heard):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    guard = SignalGuard(lambda: heard.append("guard"))
    guard.install()
    terminate()
    guard.remove()
    assert heard == []
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN


def test_an_interrupt_is_still_an_interrupt(heard):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    guard = SignalGuard(lambda: heard.append("guard"))
    guard.install()
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    guard.remove()
    signal.signal(signal.SIGINT, before)
    assert heard == ["guard"]
