"""A failure in real time is the machine's where the machine did not keep up, and nobody else's."""

import pytest
from pace import Pace, judged_by_the_pace


@pytest.mark.parametrize(
    ("worst", "others", "kept"), [(0.0, 0.0, True), (0.2, 0.0, False), (0.0, 0.9, False)]
)
def test_a_failure_is_the_machines_only_where_it_did_not_keep_up(worst, others, kept, monkeypatch):
    monkeypatch.setattr(Pace, "__exit__", lambda *_: None)
    monkeypatch.setattr(Pace, "__enter__", lambda self: self)
    monkeypatch.setattr(Pace, "__init__", lambda self: vars(self).update(worst=worst, others=others))
    with pytest.raises(AssertionError if kept else pytest.skip.Exception) as raised, judged_by_the_pace():
        raise AssertionError("motor 1 lost")
    said = "".join(getattr(raised.value, "__notes__", [])) + str(raised.value)
    assert f"{worst * 1e3:.0f} ms" in said
    assert "motor 1 lost" in said


def test_what_others_use_is_not_what_this_process_uses():
    with Pace() as pace:
        sum(range(3_000_000))
    assert 0.0 <= pace.others <= 1.0
    assert pace.worst >= 0.0
