"""`mimicik eval` from the command line to report.json, with an untrained policy."""

import json
import shutil

import numpy as np
import pytest
import torch
from evaluation_cases import Scripted, airbot, trajectory
from lerobot.datasets import LeRobotDataset

from lerobot_mimicik.batches.loading import FrameTable
from lerobot_mimicik.checkpoints import find_checkpoint
from lerobot_mimicik.cli.main import main
from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.data.writer import Episode, write_dataset
from lerobot_mimicik.evaluation.report import ROW_KEYS
from lerobot_mimicik.evaluation.rollouts import make_rollouts
from lerobot_mimicik.foresight.weights import SHIPPED
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.solvers import make_solver, register_solver
from lerobot_mimicik.solvers.availability import Package


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with dataset data/ and checkpoint run/checkpoints/last/pretrained_model/."""
    root = tmp_path_factory.mktemp("eval")
    episodes = []
    for i, length in enumerate((15, 9)):
        one = trajectory(length, index=i)
        pose = airbot().forward(torch.from_numpy(one.q)).numpy()
        episodes.append(Episode(one.q, np.roll(one.q, -1, axis=0), pose, one.target, "move", "s"))
    write_dataset(root / "data", "local/data", episodes, airbot().description)
    dataset = LeRobotDataset("local/data", root=root / "data")
    torch.manual_seed(0)
    config = MimicIKConfig(d_model=16, n_layers=1, n_heads=2, d_ff=16, device="cpu")
    config.set_dataset_feature_metadata(dataset.meta.features)
    policy = MimicIKPolicy(config)
    policy.fit_normalisation(FrameTable(dataset))
    policy.save_pretrained(root / "run" / "checkpoints" / "last" / "pretrained_model")
    return root


def test_the_report_has_all_rows_and_hold_among_them(made, capsys):
    status = main(
        [
            "eval",
            f"--policy.path={made / 'run'}",
            f"--dataset.root={made / 'data'}",
            "--mode=open_loop,closed_loop",
            f"--out={made / 'out'}",
            "--solvers=mimicik",
            "--latency_queries=3",
        ]
    )
    assert status == 0
    printed = capsys.readouterr().out
    assert "hold" in printed
    assert "data, closed loop (24 frames)" in printed
    assert max(len(line) for line in printed.splitlines() if not line.startswith("Report: ")) <= 100
    assert "<h2>What happened</h2>" in (made / "out" / "report.html").read_text()
    report = json.loads((made / "out" / "report.json").read_text())
    assert [(row["solver"], row["mode"]) for row in report["rows"]] == [
        ("mimicik", "open_loop"),
        ("hold", "open_loop"),
        ("mimicik", "closed_loop"),
        ("hold", "closed_loop"),
    ]
    for row in report["rows"]:
        assert set(ROW_KEYS) <= set(row)
        assert row["frames"] == 24
    assert "| hold |" in (made / "out" / "report.md").read_text()


def test_the_row_is_named_after_the_checkpoints_kind(made, tmp_path, capsys):
    weights = tmp_path / "without"
    shutil.copytree(made / "run" / "checkpoints" / "last" / "pretrained_model", weights)
    config = json.loads((weights / "config.json").read_text())
    (weights / "config.json").write_text(json.dumps(config | {"fk_weight": 0.0}))
    options = [f"--dataset.root={made / 'data'}", "--mode=open_loop", "--latency_queries=3"]
    for solvers in ("mimicik", "mimicik,mimicik_nofk"):
        out = tmp_path / solvers
        asked = [f"--policy.path={weights}", f"--solvers={solvers}", f"--out={out}"]
        assert main(["eval", *options, *asked]) == 0
        rows = json.loads((out / "report.json").read_text())["rows"]
        assert [row["solver"] for row in rows] == ["mimicik_nofk", "hold"]
    capsys.readouterr()
    assert main(["eval", *options, f"--policy.path={weights}", "--solvers=mlp"]) == 1
    assert "--solvers names mlp" in capsys.readouterr().err


def test_without_a_policy_the_arm_comes_from_the_dataset(made):
    out = made / "hold"
    assert main(["eval", f"--dataset.root={made / 'data'}", f"--out={out}", "--episodes=1"]) == 0
    rows = json.loads((out / "report.json").read_text())["rows"]
    assert [(row["solver"], row["frames"]) for row in rows] == [("hold", 9), ("hold", 9)]


def test_a_missing_solver_is_a_row_with_the_reason(made, capsys):
    register_solver("test_missing", needs=(Package("no_such_ik", "uv pip install no-such-ik"),))(Scripted)
    out = made / "missing"
    options = ["--mode=open_loop", "--latency_queries=3", "--solvers=test_missing,hold", f"--out={out}"]
    assert main(["eval", f"--dataset.root={made / 'data'}", *options]) == 0
    assert "test_missing is unavailable:" in capsys.readouterr().out
    rows = {row["solver"]: row for row in json.loads((out / "report.json").read_text())["rows"]}
    assert rows["test_missing"]["verdict"] == "unavailable"
    assert "uv pip install no-such-ik" in rows["test_missing"]["reason"]
    assert rows["hold"]["frames"] == 24
    assert "no_such_ik is not installed" in (out / "report.md").read_text()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--mode=half_open", "open_loop, closed_loop"),
        ("--solvers=hold,magic", "unknown magic; known are "),
        ("--solvers=mimicik", "--policy.path is missing"),
        ("--episodes=one", "'one'"),
        ("--policy.path=nowhere/at/all", "nowhere/at/all"),
    ],
)
def test_wrong_options_are_refused_with_what_exists(made, option, message, capsys):
    assert main(["eval", f"--dataset.root={made / 'data'}", option]) == 1
    assert message in capsys.readouterr().err


def test_foresight_alone_runs_the_checkpoint_that_it_is_given_or_none(made, capsys):
    # What the package ships is part of a checkpoint, no policy.
    options = ["--solvers=foresight_alone", f"--policy.path={SHIPPED / 'airbot_play'}"]
    assert main(["eval", f"--dataset.root={made / 'data'}", *options]) == 1
    assert "training_step is missing" in capsys.readouterr().err


def test_a_checkpoint_is_found_from_any_folder_above_it(made):
    weights = made / "run" / "checkpoints" / "last" / "pretrained_model"
    for folder in (weights, weights.parent, made / "run"):
        assert find_checkpoint(str(folder)).endswith("pretrained_model") or folder == weights
    with pytest.raises(FileNotFoundError, match="holds no checkpoint"):
        find_checkpoint(str(made / "data"))
    assert find_checkpoint("user/name") == "user/name"


def test_the_solver_asks_the_policy_the_same_in_every_way(made):
    """Vectorised windows, step by step, in lockstep, and the policy's own memory give the same commands."""
    solver = make_solver("mimicik", airbot(), policy=str(made / "run"))
    long, short = trajectory(12), trajectory(7, index=1)
    whole = solver.solve_recorded(long.q, long.target)
    solver.reset(long.q[:1])
    steps = np.concatenate(
        [solver.solve(long.q[t : t + 1], long.target[t : t + 1]) for t in range(len(long))]
    )
    np.testing.assert_allclose(steps, whole, atol=1e-5)

    solver.policy.reset()
    own = [
        solver.policy.predict_joints(torch.tensor(q)[None].float(), torch.tensor(x)[None].float())[0].numpy()
        for q, x in zip(long.q, long.target, strict=True)
    ]
    np.testing.assert_allclose(own, whole, atol=1e-5)

    together = make_rollouts("closed_loop", solver, [short, long])
    apart = [make_rollouts("closed_loop", solver, [one])[0] for one in (short, long)]
    for a, b in zip(together, apart, strict=True):
        np.testing.assert_allclose(a.q_cmd, b.q_cmd, atol=1e-5)


def test_what_the_robot_runs_is_a_row_and_no_untrained_network_makes_it_worse(made):
    out = made / "guided"
    options = [
        "--modes=closed_loop",
        "--latency_queries=3",
        "--solvers=mimicik,guided,mimicik_guided,guided_ahead",
    ]
    arguments = [f"--policy.path={made / 'run'}", f"--dataset.root={made / 'data'}", f"--output={out}"]
    assert main(["eval", *arguments, *options]) == 0
    rows = {row["solver"]: row for row in json.loads((out / "report.json").read_text())["rows"]}
    assert rows["mimicik_guided"]["mean_mm"] <= 1.1 * rows["guided"]["mean_mm"]
    assert rows["mimicik_guided"]["mean_mm"] < rows["mimicik"]["mean_mm"]
    assert "guided_ahead" in rows
