"""`mimicik bench` on a very small scale, and how it names, joins and keeps rows."""

import json
import shutil

import pytest
from evaluation_cases import Scripted
from teleop import write_teleop

from lerobot_mimicik import outputs
from lerobot_mimicik.cli.main import main
from lerobot_mimicik.evaluation import training_process
from lerobot_mimicik.evaluation.bench import LearnedRow, over_seeds
from lerobot_mimicik.evaluation.bench_plots import plot_errors, plot_fk_weights
from lerobot_mimicik.evaluation.report import markdown_table
from lerobot_mimicik.evaluation.rollouts import _MODES, closed_loop
from lerobot_mimicik.solvers import register_solver

TINY = {
    "small.json": {"d_model": 16, "n_layers": 1, "n_heads": 2, "d_ff": 16},
    "mlp_small.json": {"hidden_dim": 16, "n_layers": 1},
}


@register_solver("test_not_installed")
def not_installed(arm):
    raise ImportError("this solver needs a library that is not installed")


@register_solver("test_one_by_one")
def one_by_one(arm):
    return Scripted(lambda q, target, _: q)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of a finished benchmark, and its options."""
    root = tmp_path_factory.mktemp("bench")
    train = write_teleop(root / "train", episodes=3, frames=20)
    test = write_teleop(root / "test", episodes=2, frames=12, seed=5)
    (root / "recipes").mkdir()
    for name, policy in TINY.items():
        recipe = json.loads(training_process.find_recipe(name).read_text())
        recipe["policy"] |= policy
        recipe |= {"batch_size": 16, "save_freq": 2, "log_freq": 1}
        (root / "recipes" / name).write_text(json.dumps(recipe))
    options = [
        "bench", f"--train={train}", f"--datasets={test}", f"--recipes={root / 'recipes'}",
        "--steps=4", "--latency_queries=3", "--device=cpu", f"--output={root / 'out'}",
    ]  # fmt: skip
    assert main([*options, "--solvers=mlp,hold,test_not_installed", "--seeds=2"]) == 0
    return root / "out", options


def table(out):
    return json.loads((out / "table.json").read_text())


def test_the_table_has_every_row_and_says_what_is_unavailable(made):
    out, options = made
    assert main([*options, "--solvers=mlp,hold,test_not_installed", "--seeds=2"]) == 0
    rows = table(out)["rows"]
    assert [(row["mode"], row["solver"], row.get("seeds", 1)) for row in rows] == [
        ("open_loop", "mlp", 2), ("open_loop", "hold", 1), ("closed_loop", "mlp", 2), ("closed_loop", "hold", 1),
    ]  # fmt: skip
    assert all(row["frames"] == 24 for row in rows)
    assert rows[0]["std"]["mean_mm"] > 0
    assert rows[1]["std"] == {}
    page = (out / "table.md").read_text()
    assert "| test_not_installed | - |" in page.replace("test not installed", "test_not_installed")
    assert "this solver needs a library that is not installed" in page
    assert " ± " in page
    # Beside the rows: how each is configured.
    assert "- mlp: The paper's pure MLP" in page
    assert "recipe configs/mlp_small.json" in page
    assert "- hold: The command is the measured joints" in page
    assert list(outputs.strangers(out)) == []
    figures = {path.name for path in (out / "figures").iterdir()}
    motions = [f"anatomy_{name}" for name in ("wrist", "elbow", "shoulder", "out_of_reach")]
    noted = [f"{name}.{kind}" for name in ("errors_test", *motions) for kind in ("png", "txt")]
    assert figures == {*noted, "tradeoff.png", "failures.png"}
    html = (out / "report.html").read_text()
    assert "test_not_installed is unavailable" in html
    assert html.count("<figure>") == 7
    assert {path.name for path in (out / "anatomy").iterdir()} == {"mlp.npz", "hold.npz"}


def test_each_training_says_what_it_cost(made):
    training = table(made[0])["training"]
    assert {"mlp-seed0", "mlp-seed1"} <= set(training)
    for name in ("mlp-seed0", "mlp-seed1"):
        assert training[name]["steps"] == 4
        assert training[name]["minutes"] > 0
        assert "lerobot-train" in training[name]["command"]


def test_a_part_of_the_data_is_a_row_of_its_own(made):
    out, options = made
    short = [*options, "--solvers=hold", "--modes=open_loop,closed_loop", "--seconds=0.25"]
    assert main(short) == 0
    assert [row["frames"] for row in table(out)["rows"]] == [10, 10]
    assert main([*options, "--solvers=hold"]) == 0
    assert [row["frames"] for row in table(out)["rows"]] == [24, 24]


def test_only_the_plant_is_shortened_where_only_that_is_asked(made, monkeypatch):
    out, options = made
    driven = []

    def stand_in(solver, trajectories, given):
        driven.extend(len(one) for one in trajectories)
        return closed_loop(solver, trajectories, given)

    monkeypatch.setitem(_MODES, "plant", stand_in)
    assert main([*options, "--solvers=hold", "--modes=open_loop,plant", "--plant_seconds=0.75"]) == 0
    assert driven == [12, 3]
    assert [(row["mode"], row["frames"]) for row in table(out)["rows"]] == [("open_loop", 24), ("plant", 15)]


def test_another_call_adds_rows_and_repeats_nothing(made):
    out, options = made
    before = json.loads((out / "summary.json").read_text())["rows"]
    weights = out / "train" / "mlp-seed0" / "run" / "checkpoints" / "last" / "pretrained_model"
    stamp = (weights / "model.safetensors").stat().st_mtime_ns
    assert main([*options, "--solvers=mlp,test_one_by_one", "--modes=open_loop"]) == 0
    assert (weights / "model.safetensors").stat().st_mtime_ns == stamp
    after = json.loads((out / "summary.json").read_text())["rows"]
    assert after[: len(before)] == before
    assert [row["solver"] for row in after[len(before) :]] == ["test_one_by_one"]
    assert [row["solver"] for row in table(out)["rows"]] == ["mlp", "test_one_by_one"]


def test_an_interrupted_training_goes_on_from_its_checkpoint(made, tmp_path):
    out, options = made
    again = tmp_path / "out"
    shutil.copytree(out, again, symlinks=True)
    run = again / "train" / "mlp-seed0" / "run"
    shutil.rmtree(run / "checkpoints" / "000004")
    (run / "checkpoints" / "last").unlink()
    (run / "checkpoints" / "last").symlink_to("000002")
    kept = again / "train" / "mlp-seed0" / "arguments.json"
    kept.write_text(kept.read_text().replace(str(out), str(again)))
    config = run / "checkpoints" / "000002" / "pretrained_model" / "train_config.json"
    config.write_text(config.read_text().replace(str(out), str(again)))
    assert main([*options, f"--output={again}", "--solvers=mlp"]) == 0
    assert training_process.last_step(run) == 4
    assert (again / "train" / "mlp-seed0" / "logs" / "train-000002.log").is_file()


def test_some_episodes_are_rows_of_their_own(made):
    out, options = made
    for episodes, frames in (("1", 12), ("0-1", 24)):
        assert main([*options, "--solvers=hold", "--modes=open_loop", f"--episodes={episodes}"]) == 0
        assert [row["frames"] for row in table(out)["rows"]] == [frames]


def test_a_dataset_that_does_not_name_its_arm_needs_the_option(made, tmp_path, capsys):
    _, options = made
    root = tmp_path / "elsewhere"
    shutil.copytree(made[0].parent / "test", root)
    (root / "meta" / "arm.json").unlink()
    options = [
        *options,
        f"--train={root}",
        f"--datasets={root}",
        "--solvers=hold",
        f"--output={tmp_path / 'out'}",
    ]
    assert main(options) == 1
    assert "--arm" in capsys.readouterr().err
    assert main([*options, "--urdf=airbot_play", "--modes=open_loop"]) == 0


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--solvers=magic", "known are mimicik, mlp, unet_diffusion"),
        ("--modes=half_open", "open_loop, closed_loop"),
        ("--seeds=0", "at least 1"),
        ("--train=", "--train"),
        ("--datasets=", "--datasets is missing"),
        ("--steps=5", "was trained with other options"),
        ("--conditioning=paper", "was trained with other options"),
    ],
)
def test_wrong_options_are_refused(made, option, message, capsys):
    _, options = made
    assert main([*options, "--solvers=mlp", option]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "base", "options"),
    [
        ("mimicik", "mimicik", []),
        ("mimicik_nofk", "mimicik", ["--policy.fk_weight=0"]),
        ("mimicik_fk0.05", "mimicik", ["--policy.fk_weight=0.05"]),
        ("mlp_fk0.1", "mlp", ["--policy.fk_weight=0.1"]),
        ("unet_diffusion", "unet_diffusion", []),
        ("mimicik_nofk_guided", "mimicik", ["--policy.fk_weight=0"]),
    ],
)
def test_names_of_learned_rows_say_what_is_trained(name, base, options):
    row = LearnedRow.of(name)
    assert (row.base, row.options()) == (base, options)
    assert training_process.find_recipe(row.recipe("small")).is_file()
    assert training_process.find_recipe(row.recipe("paper")).is_file()


@pytest.mark.parametrize("name", ["hold", "guided", "mimicik_fk", "mimicik_", "mimicik_nofk0.1"])
def test_other_names_are_no_learned_rows(name):
    assert LearnedRow.of(name) is None


def row_of(solver="mlp", mean=1.0, verdict="Bounded", seed=0, **changes):
    keys = {
        "solver": solver, "mode": "closed_loop", "dataset": "test", "frames": 10, "mean_mm": mean, "p95_mm": mean,
        "max_mm": 3.0, "rot_mean_deg": 0.1, "sr1": 50.0, "sr5": 100.0, "sr10": 100.0, "cartesian_spike": 0.0,
        "joint_spike": 0.0, "estop": 0.0, "max_dq": 0.05, "limit_violations": 0.0, "nonfinite": 0, "jerk": 0.001,
        "latency_ms_median": 1.0, "latency_ms_p99": 2.0, "verdict": verdict, "seed": seed,
        "error_quantiles_mm": [0.1, 1.0, None],
    }  # fmt: skip
    return keys | changes


def test_seeds_become_mean_and_deviation_and_keep_every_verdict():
    rows = [row_of(mean=1.0), row_of(mean=2.0, verdict="Diverged", nonfinite=4), row_of(mean=3.0, jerk=None)]
    row, spread = over_seeds(rows)
    assert row["mean_mm"] == pytest.approx(2.0)
    assert spread["mean_mm"] == pytest.approx(1.0)
    assert row["nonfinite"] == 4
    assert row["jerk"] is None
    assert row["verdict"] == "Bounded 2/3, Diverged 1/3"
    assert "2.00 ± 1.00" in markdown_table([row], [spread])
    assert over_seeds(rows[:1]) == (rows[0], {})


def test_figures_come_from_rows_alone(tmp_path):
    rows = [
        row_of(name, seed=seed) for name in ("mimicik", "mimicik_nofk", "mimicik_fk0.5") for seed in (0, 1)
    ]
    plots = [*plot_errors(rows), plot_fk_weights(rows, 0.1)]
    assert [plot.save(tmp_path).name for plot in plots] == ["errors_test.png", "fk_weights.png"]
    assert plot_fk_weights(rows[:4], 0.1) is None
