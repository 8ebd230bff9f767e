"""`mimicik serve` as a process: started, asked and stopped; `mimicik benchmark-server` on a small scale."""

import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from evaluation_cases import airbot, trajectory

from lerobot_mimicik.cli.eval import PolicySource
from lerobot_mimicik.cli.main import main
from lerobot_mimicik.cli.options import underscored
from lerobot_mimicik.cli.serve import ServeConfig, solvers_of
from lerobot_mimicik.foresight.weights import SHIPPED
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.solvers import make_solver


@contextmanager
def command(*options):
    """The running command and the address that it says it serves; killed if the test leaves it running."""
    line = [sys.executable, "-m", "lerobot_mimicik.cli.main", "serve", "--bind=tcp://127.0.0.1:0", *options]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            shown = process.stdout.readline()
            assert shown.startswith("Serving on "), process.communicate(timeout=300)
            yield process, shown.split()[2].rstrip(";")
        finally:
            process.kill()


def ends_cleanly(process, number):
    """Whether the command ends at a signal, says what it did, and complains about nothing."""
    process.send_signal(number)
    shown, errors = process.communicate(timeout=300)
    return (
        process.returncode == 0
        and "requests answered, 0 refused" in shown
        and errors in ("", "Loading torch and LeRobot ...\n")
    )


def test_the_command_answers_until_a_signal_stops_it_cleanly():
    one = trajectory(5)
    with command("--solvers=hold", "--arm=airbot_play") as (process, address):
        remote = make_solver("remote", airbot(), address=address, solver="hold", timeout_s=300.0)
        with remote:
            np.testing.assert_array_equal(remote.solve_recorded(one.q, one.target), one.q)
        assert ends_cleanly(process, signal.SIGINT)


def test_keys_are_made_and_serve_a_client_that_has_its_own(tmp_path, capsys):
    for name in ("server", "robot"):
        assert main(["serve", f"--make-keys={tmp_path / name}", f"--key-name={name}"]) == 0
    assert "robot.key may be given to anybody" in capsys.readouterr().out
    assert main(["serve", f"--make-keys={tmp_path / 'robot'}", "--key-name=robot"]) == 1
    (tmp_path / "robot" / "not_for_the_server.key_secret").write_text("")
    keys = {
        "secret_key": str(tmp_path / "robot" / "robot.key_secret"),
        "server_key": str(tmp_path / "server" / "server.key"),
    }
    options = [f"--secret-key={tmp_path}/server/server.key_secret", f"--allowed-keys={tmp_path}/robot"]
    with command(*options) as (process, address):
        options = {"address": address, "solver": "hold", "timeout_s": 300.0} | keys
        with make_solver("remote", airbot(), **options) as remote:
            remote.reset(np.zeros(6))
        with pytest.raises(TimeoutError, match="does the server want keys"):
            make_solver("remote", airbot(), address=address, solver="hold", timeout_s=0.5)
        assert ends_cleanly(process, signal.SIGTERM)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--solvers=hold,magic", "unknown magic; known are"),
        ("--solvers=remote", "unknown remote"),
        ("--solvers=mimicik", "--policy.path is missing"),
        ("--solvers=mlp", "--policy.path is missing"),
        ("--bind=tcp://0.0.0.0:5555", "must have keys"),
        ("--bind=5555", "tcp://HOST:PORT"),
        (f"--secret_key={__file__}", "--allowed_keys belong together"),
        ("--secret_key=lost.key_secret", "lost.key_secret does not exist"),
        ("--arm=nowhere", "nowhere"),
        ("--max_rows=0", "max_rows must be at least 1"),
    ],
)
def test_wrong_options_are_refused_with_what_would_do(option, message, capsys):
    assert main(["serve", "--bind=tcp://127.0.0.1:0", option]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--window=32", "--window=32: expected 1 to 16"),
        ("--window=0", "--window=0: expected 1 to 16"),
        ("--rounds=0", "--rounds=0: expected at least 1"),
        ("--seconds=nan", "--seconds=nan: expected"),
        ("--clients=0", "--clients=0: expected 1 to"),
        ("--batch_rows=0", "--batch_rows=0: expected 1 to"),
        ("--bind=5555", "tcp://HOST:PORT"),
        ("--bind=tcp://0.0.0.0:5555", "address of this computer"),
        ("--solver=mimicik", "--policy.path is missing"),
        ("--policy.path=./nowhere", "nowhere does not exist"),
    ],
)
def test_what_the_benchmark_cannot_measure_is_refused_before_a_server_starts(option, message, capsys):
    assert main(["benchmark-server", option]) == 1
    assert message in capsys.readouterr().err


def test_a_server_of_foresight_answers_with_the_checkpoint_that_it_was_given():
    own = ServeConfig(PolicySource(str(SHIPPED / "piper")), solvers="foresight,foresight_alone")
    arm, factories = solvers_of(own)
    assert arm.description.tip_link == describe_arm("piper").tip_link
    for make in factories.values():
        make().reset(np.array(describe_arm("piper").home))
    _, factories = solvers_of(replace(own, arm="airbot_play"))
    with pytest.raises(ValueError, match="another arm's"):
        factories["foresight"]()


def test_dashes_in_option_names_are_as_good_as_underscores():
    argv = ["--make-keys=a-b", "--policy.path", "c-d", "--x"]
    assert underscored(argv) == ["--make_keys=a-b", "--policy.path", "c-d", "--x"]


def test_the_benchmark_prints_both_figures_as_ratios(capsys):
    options = ["--rounds=1", "--seconds=0.2", "--clients=1", "--batch_rows=64"]
    assert main(["benchmark-server", *options]) == 0
    shown = capsys.readouterr().out
    assert "ratio, server to this process" in shown
    assert "1 clients with 16 under way" in shown
    assert "longest delay by the batches" in shown
