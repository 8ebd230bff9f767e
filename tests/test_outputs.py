"""What commands may replace and delete: only what carries the project's mark, and nothing else."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hand_recordings import hand_table

from lerobot_mimicik import outputs
from lerobot_mimicik.cli import main as cli
from lerobot_mimicik.cli import make_dataset
from lerobot_mimicik.data.writer import Episode, write_dataset
from lerobot_mimicik.evaluation import training_process
from lerobot_mimicik.evaluation.report import write_report
from lerobot_mimicik.evaluation.result_pages import DOCUMENT_MARK
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain

ARM = describe_arm("airbot_play")


def write(root: Path, frames: int = 3, **options):
    q = np.tile(ARM.home, (frames, 1))
    pose = array_chain(ARM).pose(q)
    return write_dataset(root, "local/set", [Episode(q, q, pose, pose, "wait", "s")], ARM, **options)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, and its bytes."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_dataset_is_marked_and_all_of_it_is_ours(tmp_path):
    write(tmp_path / "set")
    assert outputs.kind_of(tmp_path / "set") == "dataset"
    assert list(outputs.strangers(tmp_path / "set")) == []
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    write(tmp_path / "set", frames=5, overwrite=True)
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["total_frames"] == 5
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize(
    "stranger", ["notes.txt", "meta/notes.txt", "data/chunk-000/raw.csv", "videos/a/b.mp4"]
)
def test_a_dataset_with_a_foreign_file_is_not_replaced_and_the_file_is_named(tmp_path, stranger):
    write(tmp_path / "set")
    (tmp_path / "set" / stranger).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "set" / stranger).write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=Path(stranger).name):
        write(tmp_path / "set", overwrite=True)
    assert contents(tmp_path) == before


def test_a_folder_without_a_mark_is_not_replaced_and_its_owner_may_mark_it(tmp_path):
    write(tmp_path / "set")
    (tmp_path / "set" / outputs.MARK_FILE).unlink()
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match="not marked as a dataset") as refused:
        write(tmp_path / "set", overwrite=True)
    assert contents(tmp_path) == before
    subprocess.run(str(refused.value).split("replacing it: ")[1], shell=True, check=True)
    write(tmp_path / "set", overwrite=True)


@pytest.mark.parametrize(
    ("source", "beside"), [("ee", "set.writing"), ("ee", "set.parts"), ("joints", "set.writing")]
)
def test_folders_that_only_have_our_working_folders_names_are_kept(tmp_path, capsys, source, beside):
    (tmp_path / beside).mkdir()
    (tmp_path / beside / "precious.txt").write_text("mine")
    table = hand_table(1, seconds=1.0)
    if source == "joints":
        table[[f"q{i}" for i in range(1, 7)]] = ARM.home
    table.to_csv(tmp_path / "in.csv", index=False)
    arguments = [
        f"--source={source}",
        f"--input={tmp_path / 'in.csv'}",
        f"--output={tmp_path / 'set'}",
        "--workers=0",
    ]
    assert make_dataset.main([*arguments, "--fit.min_duration=0.4"]) == 2
    assert f"{beside} is not marked" in capsys.readouterr().err
    assert (tmp_path / beside / "precious.txt").read_text() == "mine"


@pytest.mark.parametrize("source", ["ee", "joints"])
@pytest.mark.parametrize(
    ("given", "output"),
    [("rec", "rec"), ("rec/in.csv", "rec"), ("rec", "rec/out"), ("link", "rec"), ("rec", "link/out")],
)
def test_recordings_never_lie_in_the_output_nor_the_output_in_them(tmp_path, capsys, source, given, output):
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "in.csv").write_text("t,q1\n")
    outputs.mark(tmp_path / "rec", "dataset")
    (tmp_path / "link").symlink_to(tmp_path / "rec")
    arguments = [
        f"--source={source}",
        f"--input={tmp_path / given}",
        f"--output={tmp_path / output}",
        "--overwrite",
    ]
    assert make_dataset.main(arguments) == 2
    assert "to another folder" in capsys.readouterr().err
    assert (tmp_path / "rec" / "in.csv").exists()


def test_what_a_killed_run_left_is_replaced(tmp_path):
    outputs.mark(tmp_path / "set.writing", "writing")
    outputs.mark(tmp_path / "set.writing" / "new", "dataset")
    (tmp_path / "set.writing" / "new" / "data" / "chunk-000").mkdir(parents=True)
    (tmp_path / "set.writing" / "new" / "data" / "chunk-000" / "file-000.parquet").write_text("half")
    write(tmp_path / "set")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_failed_replacement_leaves_the_dataset_as_it_was(tmp_path):
    write(tmp_path / "set")
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="no episode"):
        write_dataset(tmp_path / "set", "local/set", [], ARM, overwrite=True)
    assert contents(tmp_path) == before


def test_links_are_deleted_and_never_followed(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("mine")
    outputs.mark(tmp_path / "out", "benchmark")
    checkpoints = tmp_path / "out" / "train" / "mlp" / "run" / "checkpoints"
    (checkpoints / "000001").mkdir(parents=True)
    (checkpoints / "last").symlink_to(tmp_path / "home")
    outputs.remove(tmp_path / "out")
    assert contents(tmp_path) == {"home/thesis.tex": b"mine"}


@pytest.mark.parametrize(
    ("kind", "stranger"),
    [
        ("report", "figures/thesis.pdf"),
        ("demo", "figures/mine/own.png"),
        ("demo", "train/checkpoints/notes.txt"),
        ("demo", "train/checkpoints/000001/pretrained_model/best.pt"),
        ("benchmark", "train/mlp/run/checkpoints/mine.json"),
    ],
)
def test_foreign_files_among_figures_and_checkpoints_are_kept(tmp_path, kind, stranger):
    outputs.mark(tmp_path / "out", kind)
    file = tmp_path / "out" / stranger
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    with pytest.raises(FileExistsError, match=file.name):
        outputs.remove(tmp_path / "out")
    assert file.read_text() == "mine"


def test_a_training_that_begins_anew_deletes_only_what_a_training_left(tmp_path):
    outputs.mark(tmp_path / "demo", "demo")
    run = tmp_path / "demo" / "train"
    half = run / "checkpoints" / "000003" / "training_state" / "half.safetensors"
    half.parent.mkdir(parents=True)
    half.write_text("")
    (run / "my_notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="my_notes"):
        training_process.train_or_resume(["--nonsense"], run, 5, 1, tmp_path / "demo" / "logs")
    assert half.exists()
    (run / "my_notes.txt").unlink()
    outputs.remove(run)
    assert not run.exists()


def test_reports_of_others_are_kept_and_our_own_are_written_anew(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "report.md").write_text("mine")
    with pytest.raises(FileExistsError, match=r"report\.md would be replaced"):
        write_report(tmp_path / "mine", [], [], {})
    assert contents(tmp_path) == {"mine/report.md": b"mine"}
    for _ in range(2):
        write_report(tmp_path / "ours", [], [], {})
    assert list(outputs.strangers(tmp_path / "ours")) == []


@pytest.mark.parametrize(
    ("command", "options", "written"),
    [
        ("deploy", ["--display_file={}"], b"RRF2....mimicik_deploy"),
        ("play", ["--screenshot={}"], b"\x89PNG....mimicik play"),
        ("bench", ["--markdown={}", "--datasets={set}", "--solvers=hold"], DOCUMENT_MARK.encode()),
    ],
)
def test_a_file_that_an_option_names_is_replaced_only_where_this_project_wrote_it(
    tmp_path, capsys, command, options, written
):
    write(tmp_path / "set")
    file = tmp_path / "thesis.pdf"
    file.write_bytes(b"\xff mine")
    line = [option.format(file, set=tmp_path / "set") for option in options]
    assert cli.main([command, *line]) == 1
    assert f"{file} exists already and is not replaced" in capsys.readouterr().err
    assert file.read_bytes() == b"\xff mine"
    file.write_bytes(written)
    outputs.check_file(file, "--x", written[-12:])
    outputs.check_file(tmp_path / "new" / "file", "--x")
    with pytest.raises(FileExistsError):
        outputs.check_file(file, "--x")


@pytest.mark.parametrize(
    ("command", "output"),
    [
        (["make-dataset", "--source=synthetic", "--episodes=2"], "output"),
        (["make-dataset", "--source=stress"], "output"),
        (["demo"], "output"),
        (["bench", "--datasets=set"], "output"),
        (["eval", "--dataset.root=set"], "output"),
        (["deploy", "--dataset.root=set"], "out"),
    ],
)
def test_a_second_run_into_one_output_is_refused(tmp_path, capsys, command, output):
    with outputs.alone(tmp_path / "out"):
        assert cli.main([*command, f"--{output}={tmp_path / 'out'}"]) in (1, 2)
    assert f"another run is writing to {tmp_path / 'out'}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_was_killed_locks_nobody_out(tmp_path):
    code = "import sys, time; from lerobot_mimicik import outputs\n"
    code += "with outputs.alone(sys.argv[1]): print('held', flush=True); time.sleep(3600)"
    out = str(tmp_path / "made" / "out")
    with subprocess.Popen([sys.executable, "-c", code, out], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(FileExistsError, match="another run is writing"), outputs.alone(out):
            pass
        other.kill()
        other.wait()
    with outputs.alone(out):
        pass
    assert list((tmp_path / "made").iterdir()) == []


def test_somebodys_own_lock_file_is_kept(tmp_path):
    (tmp_path / "out.lock").write_text("mine")
    with outputs.alone(tmp_path / "out"):
        pass
    assert contents(tmp_path) == {"out.lock": b"mine"}


def test_no_stress_set_is_made_where_the_last_one_may_not_be_written(tmp_path, capsys):
    (tmp_path / "out" / "tremor-1mm").mkdir(parents=True)
    (tmp_path / "out" / "tremor-1mm" / "notes.txt").write_text("mine")
    options = ["--source=stress", "--episodes=1", "--stress.seconds=1", "--stress.kinds=workspace,tremor-1mm"]
    assert make_dataset.main([*options, f"--output={tmp_path / 'out'}"]) == 2
    assert "tremor-1mm exists already" in capsys.readouterr().err
    assert contents(tmp_path) == {"out/tremor-1mm/notes.txt": b"mine"}


WORK = """
import os, sys, time
from lerobot_mimicik.data.workers import worker_pool

def begin():
    print("working", flush=True)

if __name__ == "__main__":
    pool = worker_pool(2, begin)
    pool.submit(time.sleep, 0.0).result()
    print("idle", flush=True)
    time.sleep(3600)
"""


def test_workers_end_when_their_parent_is_killed(tmp_path):
    (tmp_path / "work.py").write_text(WORK)
    parent = subprocess.Popen([sys.executable, tmp_path / "work.py"], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    while "idle" not in (line := parent.stdout.readline()):
        assert line, "the pool did not start"
    parent.kill()
    # The workers write to the same pipe: it ends when the last of them has.
    parent.communicate(timeout=600)
