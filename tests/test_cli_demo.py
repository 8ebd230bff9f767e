"""`mimicik demo` from nothing to its report on a very small scale; how it treats what is already there."""

import json
import sys

import pytest

from lerobot_mimicik import outputs
from lerobot_mimicik.cli import demo
from lerobot_mimicik.cli.main import main
from lerobot_mimicik.evaluation import training_process

SCALE = ["--episodes=2", "--ood_seconds=4", "--steps=6", "--workers=1", "--device=cpu"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Output folder and recipe of a finished demo."""
    root = tmp_path_factory.mktemp("demo")
    recipe = json.loads(training_process.find_recipe("small.json").read_text())
    recipe["policy"] |= {"d_model": 16, "n_layers": 1, "n_heads": 2, "d_ff": 16}
    recipe |= {"batch_size": 16, "save_freq": 3}
    (root / "tiny.json").write_text(json.dumps(recipe))
    options = [*SCALE, f"--output={root / 'out'}", f"--recipe={root / 'tiny.json'}"]
    assert main(["demo", *options]) == 0
    return root / "out", options


def test_the_demo_leaves_data_checkpoint_report_and_page(made):
    output, _ = made
    rows = json.loads((output / "eval" / "report.json").read_text())["rows"]
    assert {(row["solver"], row["mode"], row["dataset"]) for row in rows} == {
        (solver, mode, dataset)
        for solver in ("mimicik", "guided", "hold")
        for mode in ("open_loop", "closed_loop")
        for dataset in ("test", "ood")
    }
    assert training_process.last_step(output / "train") == 6
    page = (output / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(list((output / "figures").glob("*.png"))) >= 4
    assert "synthetic" in page
    # The first thing to see is the arm in motion.
    assert page.index("data:image/gif;base64,") < page.index("data:image/png;base64,")
    curves = training_process.read_curves(output / "logs", log_freq=1)
    assert curves["loss"].steps == [1, 2, 3, 4, 5, 6]
    assert list(outputs.strangers(output)) == []  # so that --overwrite can replace it


def test_a_second_run_asks_what_to_do_with_the_first(made, capsys):
    output, options = made
    assert main(["demo", *options]) == 1
    shown = capsys.readouterr().err
    assert "--resume" in shown
    assert "--overwrite" in shown
    assert (output / "report.html").is_file()


def test_resuming_with_other_options_is_refused(made, capsys):
    _, options = made
    assert main(["demo", *options, "--resume", "--seed=5"]) == 1
    assert "seed=0" in capsys.readouterr().err


def test_resuming_a_finished_run_makes_the_report_anew_and_nothing_else(made):
    output, options = made
    (output / "report.html").unlink()
    kept = {path: path.stat().st_mtime_ns for path in [*output.glob("data/**/*"), *output.glob("logs/*")]}
    assert main(["demo", *options, "--resume"]) == 0
    assert (output / "report.html").is_file()
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


def test_a_folder_of_somebody_else_is_never_overwritten(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(FileExistsError, match="not marked as a demo"):
        demo.run(demo.DemoConfig(output=str(tmp_path), overwrite=True))
    assert (tmp_path / "thesis.tex").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"source": "magic"}, "synthetic or ee"),
        ({"source": "ee"}, "--input"),
        ({"input": "x.parquet"}, "--input"),
        ({"resume": True, "overwrite": True}, "choose one"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        demo.run(demo.DemoConfig(output=str(tmp_path / "out"), **options))


def test_an_unknown_recipe_is_refused_with_where_it_was_looked_for():
    with pytest.raises(FileNotFoundError, match=r"(?s)huge\.json.*configs"):
        training_process.find_recipe("huge.json")


def test_a_failed_training_says_what_it_printed(tmp_path, monkeypatch):
    # lerobot-train takes ten seconds before it refuses an option.
    failing = (sys.executable, "-c", "import sys; sys.exit(f'refused {sys.argv[1]}')")
    monkeypatch.setattr(training_process, "_COMMAND", failing)
    with pytest.raises(RuntimeError, match=r"(?s)failed with status 1.*refused --nonsense=1"):
        training_process.train(["--nonsense=1"], 5, 1, tmp_path / "logs")
    assert "refused --nonsense=1" in (tmp_path / "logs" / "train-000000.log").read_text()
