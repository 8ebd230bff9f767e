"""The `mimicik` command: what it lists, what it refuses and what it leaves unimported."""

import subprocess
import sys
from dataclasses import dataclass, field

import pytest

from lerobot_mimicik.cli import main as cli
from lerobot_mimicik.cli.options import bare_switches, join_repeated, numbers, parse


def test_help_lists_every_subcommand_with_what_it_does(capsys):
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    known = cli.subcommands()
    assert {"demo", "eval", "make-dataset"} <= set(known)
    for name, text in known.items():
        assert name in shown
        assert text in shown
        assert len(text) > 20


def test_an_unknown_subcommand_is_refused_with_the_known_ones(capsys):
    assert cli.main(["evaluate"]) == 2
    shown = capsys.readouterr().err
    assert "'evaluate'" in shown
    assert all(name in shown for name in cli.subcommands())


def test_a_reader_who_has_enough_is_no_error():
    command = f"{sys.executable} -m lerobot_mimicik.cli.main --help | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stderr == ""


def test_help_imports_neither_torch_nor_lerobot():
    code = (
        "import sys; from lerobot_mimicik.cli.main import main; main(['--help']); "
        "sys.exit(bool({'torch', 'lerobot', 'numpy'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_an_error_of_the_user_is_one_line_without_a_traceback(capsys, monkeypatch):
    monkeypatch.delenv("MIMICIK_TRACEBACK", raising=False)
    assert cli.main(["eval", "--dataset.root=/nowhere/at/all", "--solvers=hold"]) == 1
    shown = capsys.readouterr().err
    assert "/nowhere/at/all" in shown
    assert "Traceback" not in shown
    monkeypatch.setenv("MIMICIK_TRACEBACK", "1")
    with pytest.raises(FileNotFoundError):
        cli.main(["eval", "--dataset.root=/nowhere/at/all", "--solvers=hold"])


@pytest.mark.parametrize(
    ("argv", "meant"),
    [
        (["evall"], "eval"),
        (["eval", "--outputt=x"], "--output"),
        (["make-dataset", "--robot.hom=1"], "--robot.home"),
        (["make-dataset", "--columns.quaternion_ordr=wxyz"], "--columns.quaternion_order"),
        (["make-dataset", "--source=joint", "--output=x"], "joints"),
        (["make-dataset", "--source=stress", "--output=x", "--stress.kinds=tremor-1"], "tremor-1mm"),
        (["make-dataset", "--source=synthetic", "--output=x", "--robot=airbotplay"], "airbot_play"),
        (["serve", "--solvers=guidet"], "guided"),
        (["play", "--solver=guided"], "--solvers"),
        (["wrap", "--ik.adress=x"], "--ik.address"),
        (["deploy", "--look_ahed=3"], "--look_ahead"),
    ],
)
def test_a_mistyped_name_gets_the_one_that_was_meant(argv, meant, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert cli.main(argv) in (1, 2)
    shown = capsys.readouterr().err
    assert f"Did you mean {meant}?" in shown
    assert "Traceback" not in shown


@pytest.mark.parametrize("command", sorted(cli.subcommands()))
def test_each_subcommand_explains_its_options(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "--help"])
    assert stopped.value.code == 0
    assert f"usage: mimicik {command}" in capsys.readouterr().out


def test_repeated_options_are_joined():
    argv = ["--dataset.root=a", "--out=x", "--dataset.root", "b"]
    assert join_repeated(argv, "--dataset.root") == ["--out=x", "--dataset.root=a,b"]
    assert join_repeated(["--out=x"], "--dataset.root") == ["--out=x"]


def test_numbers_and_ranges_are_read():
    assert numbers("0-2,7", "--episodes") == [0, 1, 2, 7]
    assert numbers("", "--episodes") == []
    with pytest.raises(ValueError, match=r"--episodes: '3-x'"):
        numbers("3-x", "--episodes")


def test_bare_switches_mean_true():
    from lerobot_mimicik.cli.demo import DemoConfig

    argv = ["--resume", "--steps", "5", "--overwrite", "false"]
    assert bare_switches(argv, DemoConfig) == ["--resume=true", "--steps", "5", "--overwrite", "false"]


@pytest.mark.parametrize("command", sorted(cli.subcommands()))
def test_help_fits_a_screen(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "110")
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 50
    assert all(len(line) <= 125 for line in lines)


@dataclass
class _Group:
    """A group of options."""

    # Where it lies.
    root: str = ""


@dataclass
class _Config:
    """Options of a command."""

    dataset: _Group = field(default_factory=_Group)
    # Where it goes.
    output: str = "here"
    # Which arm.
    arm: str = ""
    # A switch.
    overwrite: bool = False


@pytest.mark.parametrize(
    ("argument", "value", "word"),
    [
        ("--out=x", ("output", "x"), "--out is now written --output"),
        ("--robot=x", ("arm", "x"), "--robot is now written --arm"),
        ("--dataset=x", ("dataset", _Group("x")), ""),
        ("--datasets=x", ("dataset", _Group("x")), ""),
        ("--dataset_root=x", ("dataset", _Group("x")), "--dataset_root is now written --dataset.root"),
        ("--overwrite", ("overwrite", True), ""),
    ],
)
def test_one_vocabulary_is_understood_and_former_spellings_with_a_word(argument, value, word, capsys):
    config = parse(_Config, [argument], "command")
    assert getattr(config, value[0]) == value[1]
    assert capsys.readouterr().err.strip() == word


def test_help_of_a_group_and_of_one_that_does_not_exist(capsys):
    with pytest.raises(SystemExit):
        parse(_Config, ["--help=dataset"], "command")
    shown = capsys.readouterr().out
    assert "--dataset.root=" in shown
    assert "--output" not in shown
    with pytest.raises(ValueError, match="groups are dataset"):
        parse(_Config, ["--help=nothing"], "command")
