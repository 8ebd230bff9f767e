"""The schema of report.json and the tables made from it."""

import json

import pytest
from evaluation_cases import FPS, DampedLeastSquares, airbot, trajectory

from lerobot_mimicik.evaluation.evaluate import evaluate, study
from lerobot_mimicik.evaluation.page import Card, Page, render
from lerobot_mimicik.evaluation.report import ROW_KEYS, markdown_table, write_report
from lerobot_mimicik.evaluation.trajectories import TrajectorySet
from lerobot_mimicik.solvers import make_solver

SPEC = (
    "solver, mode, dataset, frames, mean_mm, p95_mm, max_mm, rot_mean_deg, sr1, sr5, sr10, "
    "cartesian_spike, joint_spike, estop, max_dq, limit_violations, nonfinite, jerk, latency_ms_median, "
    "latency_ms_p99, verdict"
)


@pytest.fixture(scope="module")
def evaluations():
    from pathlib import Path

    short = TrajectorySet("short", Path("short"), FPS, (trajectory(10), trajectory(12, index=1)))
    wrist = TrajectorySet("wrist", Path("wrist"), FPS, (trajectory(60, through_wrist=True),))
    solvers = {"dls": DampedLeastSquares(airbot(), 2, 0.03), "hold": make_solver("hold", airbot())}
    recordings = [study(airbot(), one) for one in (short, wrist)]
    return list(evaluate(airbot(), solvers, recordings, ["open_loop", "closed_loop"], latency_queries=5))


def test_there_is_a_row_for_each_solver_mode_and_dataset(evaluations):
    found = {(one.row["dataset"], one.row["mode"], one.row["solver"]) for one in evaluations}
    assert len(evaluations) == len(found) == 8
    for one in evaluations:
        assert [key for key in ROW_KEYS if key not in one.row] == []
        assert one.row["cartesian_spike"] == 100 - one.row["sr10"]
        assert one.row["latency_ms_median"] <= one.row["latency_ms_p99"]


def test_a_verdict_is_given_where_commands_feed_back(evaluations):
    for one in evaluations:
        if one.row["mode"] == "open_loop":
            assert one.row["verdict"] == "-"
        elif one.row["solver"] == "hold" and one.row["dataset"] == "wrist":
            assert one.row["verdict"] == "Singular"
        elif one.row["solver"] == "dls":
            assert one.row["verdict"] == "Bounded"


def test_report_json_has_the_agreed_keys_and_is_strict_json(tmp_path, evaluations):
    assert ", ".join(ROW_KEYS) == SPEC
    rows = [dict(one.row) for one in evaluations]
    rows[0]["max_dq"] = float("inf")
    recordings = list(dict.fromkeys(one.recording for one in evaluations))
    json_path, markdown_path = write_report(tmp_path / "new" / "out", rows, recordings, {"seed": 0})

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    report = json.loads(json_path.read_text(), parse_constant=refuse)
    assert report["rows"][0]["max_dq"] is None
    assert [row["solver"] for row in report["rows"]] == [row["solver"] for row in rows]
    assert report["datasets"][1]["singular_passages"] == 1
    assert report["machine"]["torch_threads"] >= 1
    assert markdown_path.read_text().count("\n| ") >= 9


def test_a_row_without_a_key_is_refused(tmp_path, evaluations):
    row = {key: value for key, value in evaluations[0].row.items() if key != "jerk"}
    with pytest.raises(ValueError, match=r"dls lacks jerk"):
        write_report(tmp_path, [row], [], {})


def test_the_markdown_table_has_as_many_cells_in_every_line(evaluations):
    lines = markdown_table([{**evaluations[0].row, "mean_mm": None}, evaluations[1].row]).strip().split("\n")
    assert len({line.count("|") for line in lines}) == 1
    assert "| - |" in lines[2]


def test_the_page_stands_alone_and_escapes_what_it_shows(evaluations):
    rows = [{**one.row, "solver": "<b>"} for one in evaluations]
    text = render(Page("T", "lead & more", [Card("1 < 2", "x")], rows, facts={"a": "b"}))
    assert "&lt;b&gt;" in text
    assert "<b></td>" not in text
    assert "lead &amp; more" in text
    assert "1 &lt; 2" in text
    assert "http" not in text
    assert text.count('<tr class="group">') == 4
