"""The short table, the words, the figures and the pages made of rows."""

import pytest

from lerobot_mimicik.evaluation.bench import over_seeds
from lerobot_mimicik.evaluation.result_pages import check_document, results_markdown, write_bench_page
from lerobot_mimicik.evaluation.short_table import COLUMNS, SCREEN_WIDTH, markdown, screen_table
from lerobot_mimicik.evaluation.tradeoff_plots import plot_failures, plot_tradeoff
from lerobot_mimicik.evaluation.words import describe_rows, failures_markdown, where_peers_are_ahead


def row(solver, mean=1.0, jerk=10.0, dataset="near-singular", failures=None, clean=None, **changes):
    values = {
        "solver": solver, "mode": "closed_loop", "dataset": dataset, "frames": 12345, "episodes": 20,
        "mean_mm": mean, "p95_mm": 2 * mean, "max_mm": 9 * mean, "clean_mean_mm": clean, "jerk_rms": jerk,
        "max_dq": 0.0949, "frozen": 0.0, "latency_ms_median": 0.25, "latency_ms_p99": 1234.5678,
        "verdict": "Singular" if failures else "Bounded", "reason": "", "failures": failures or {},
        "ci95": {"mean_mm": [0.9 * mean, 1.1 * mean]},
    }  # fmt: skip
    return values | changes


ROWS = [
    row("guided", 0.2, 20.0),
    row("mink", 0.4, 10.0),
    row("a_solver_with_quite_a_long_name_indeed", 123456.789, 99999.9, failures={"caught": 3, "E-stop": 1}),
    row("hold", 80.0, 0.0, failures={"frozen": 20}),
    row("guided", 0.9, 30.0, "tremor-1mm", clean=0.8),
    row("mink", 0.1, 12.0, "tremor-1mm", clean=0.7),
    row("hold", 80.0, 0.0, "tremor-1mm", mode="open_loop", verdict="-"),
]


def test_the_table_fits_the_screen_and_loses_no_row():
    text = screen_table(ROWS, {"placo": "not installed: " + "x" * 200})
    lines = text.splitlines()
    assert max(map(len, lines)) <= SCREEN_WIDTH
    assert "placo is unavailable: not installed" in text
    assert sum(line.startswith(("guided", "mink", "a_solver", "hold")) for line in lines) == len(ROWS)
    assert "4/20" in text
    assert "0/20" in text
    assert "…" not in next(line for line in lines if line.startswith("guided"))


def test_every_heading_has_its_unit_and_markdown_has_the_same_columns():
    assert all(heading.split()[-1] in ("mm", "rad", "rad/s³", "%", "ms") for _, heading, *_ in COLUMNS)
    tables = [line for line in markdown(ROWS).splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in tables}) == 1


def test_words_name_the_most_exact_and_do_not_praise_a_solver_that_fails():
    near, tremor = describe_rows(ROWS)[:2]
    assert "guided is the most exact, 0.2 mm" in near
    assert "mink is the smoothest without a failure" in near
    assert "a_solver_with_quite_a_long_name_indeed 4" in near
    assert "mink is the most exact, 0.7 mm on average against the clean target" in tremor
    assert "hold is the" not in near


def test_a_peer_is_ahead_only_in_both_error_and_jerk():
    (ahead,) = where_peers_are_ahead(ROWS)
    assert ahead.startswith("tremor-1mm")
    assert "mink (0.7 mm, 12 rad/s³)" in ahead
    assert where_peers_are_ahead(ROWS[:4]) == [
        "On no set is a peer ahead of this project's best row in both error and jerk."
    ]
    assert where_peers_are_ahead(ROWS[1:4]) == []


def test_the_tradeoff_has_a_panel_a_set_and_stays_legible_at_400_pixels():
    plot = plot_tradeoff(ROWS)
    assert len(plot.figure.axes) == 2  # holding still has no panel
    points_per_pixel = 72 * plot.figure.get_figwidth() / 400
    sizes = [
        text.get_fontsize() for axes in plot.figure.axes for text in (axes.title, *axes.get_xticklabels())
    ]
    assert min(sizes) / points_per_pixel >= 9
    assert plot_tradeoff([row("x", jerk=None)]) is None


def test_failures_are_counted_by_kind_over_all_sets():
    assert "24 recordings failed" in plot_failures(ROWS).caption
    assert "| hold | 0 | 0 | 20 | 0 | 0 |" in failures_markdown(ROWS)
    assert plot_failures([row("x", verdict="-")]) is None


def test_seeds_add_their_failures():
    joined, _ = over_seeds(
        [row("x", failures={"caught": 1}, seed=0), row("x", failures={"caught": 2}, seed=1)]
    )
    assert joined["failures"] == {"caught": 3}
    assert "3/40" in screen_table([joined])
    assert "ci95" not in joined


def test_page_and_document_say_what_happened_and_what_is_missing(tmp_path):
    missing, notes = {"placo": "not installed"}, ["near-singular: 20 episodes."]
    page = write_bench_page(tmp_path, ROWS, missing, notes, [], "mimicik bench --datasets=x").read_text()
    document = results_markdown(ROWS, missing, notes, "mimicik bench --datasets=x")
    for text in (page, document):
        for part in (
            "placo is unavailable",
            "mink is the most exact",
            "mimicik bench --datasets=x",
            "guided",
        ):
            assert part in text
    assert "## Where a peer is ahead" in document
    assert page.count("data:image/png") == 2
    assert 'src="http' not in page


def test_only_a_document_of_the_bench_is_written_again(tmp_path):
    file = tmp_path / "results.md"
    check_document(file)
    file.write_text(results_markdown(ROWS, {}, [], "mimicik bench"))
    check_document(file)
    file.write_text("# My own notes")
    with pytest.raises(
        FileExistsError, match=r"--markdown: .*results\.md exists already and is not replaced"
    ):
        check_document(file)


@pytest.mark.parametrize("key", ["jerk_rms", "failures", "ci95", "clean_mean_mm", "frozen"])
def test_rows_of_older_summaries_lack_columns_and_are_shown(key):
    old = {name: value for name, value in row("mlp").items() if name != key}
    assert "mlp" in screen_table([old])
    describe_rows([old])
    plot_tradeoff([old])
