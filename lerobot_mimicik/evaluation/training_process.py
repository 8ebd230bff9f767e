"""Running `lerobot-train` as its own process, with its progress on one bar and all it prints in a file."""

from __future__ import annotations

import codecs
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from tqdm import tqdm

from lerobot_mimicik import outputs
from lerobot_mimicik.evaluation.training_log import TrainingLog, joined, split_output

# The console command `lerobot-train` is this module's main, here with the interpreter that runs now.
_COMMAND = (sys.executable, "-m", "lerobot.scripts.lerobot_train")
_RECIPE_FOLDERS = (
    Path("configs"),
    Path(__file__).parents[2] / "configs",
    Path(__file__).parents[1] / "configs",
)


def find_recipe(name: str) -> Path:
    """A training recipe by path, or by file name in `configs/`: here, in the checkout, or in the package.

    Raises:
        FileNotFoundError: If it is nowhere; the message lists where it was looked for.
    """
    if Path(name).is_file():
        return Path(name)
    for folder in _RECIPE_FOLDERS:
        if (folder / name).is_file():
            return folder / name
    looked = ", ".join(str(folder) for folder in _RECIPE_FOLDERS)
    raise FileNotFoundError(f"There is no training recipe {name}; looked in {looked}.")


def last_step(run: Path) -> int:
    """Steps of a training run's last checkpoint, 0 without one."""
    last = run / "checkpoints" / "last"
    return int(last.resolve().name) if last.is_dir() and last.resolve().name.isdigit() else 0


def shown(arguments: Sequence[str]) -> str:
    """The command line as a user types it."""
    return shlex.join(["lerobot-train", *arguments])


def train(arguments: Sequence[str], steps: int, log_freq: int, logs: Path, start: int = 0) -> None:
    """Run `lerobot-train` to its end.

    Args:
        arguments: Its command line.
        steps: Steps in all, for the bar.
        log_freq: Its option of that name.
        logs: Folder for what it prints; one file for each start.
        start: Step that a resumed run goes on from.

    Raises:
        RuntimeError: If it fails; the message ends with the last lines that it printed.
    """
    logs.mkdir(parents=True, exist_ok=True)
    path = _log_path(logs, start)
    log = TrainingLog(log_freq, step=start)
    # A terminal is redrawn; a file keeps every state of the bar.
    interval = 0.5 if sys.stderr.isatty() else 10.0
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
    pending = ""
    with (
        path.open("wb") as file,
        tqdm(total=steps, initial=start, desc="training", unit="step", mininterval=interval) as bar,
        subprocess.Popen(
            [*_COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as process,
    ):
        assert process.stdout is not None  # of Popen with a pipe
        while chunk := os.read(process.stdout.fileno(), 65536):
            file.write(chunk)
            file.flush()
            *lines, pending = (pending + decoder.decode(chunk)).replace("\r", "\n").split("\n")
            for line in lines:
                if log.read(line):
                    bar.set_postfix_str(_postfix(log), refresh=False)
                    bar.update(min(log.step, steps) - bar.n)
        status = process.wait()
    if status:
        printed = [line for line in split_output(path.read_text(errors="replace")) if not log.read(line)]
        raise RuntimeError(
            f"lerobot-train failed with status {status}; all it printed is in {path}. The end of it:\n"
            + "\n".join(printed[-15:])
        )


def train_or_resume(
    fresh: Sequence[str],
    run: Path,
    steps: int,
    log_freq: int,
    logs: Path,
    say: Callable[[str], None] = print,
) -> int:
    """Run `lerobot-train` up to `steps`, from the last checkpoint if there is one.

    Args:
        fresh: Its command line for a new run.
        run: Its output folder, named in `fresh` too. What a run without a checkpoint left in it is deleted, if it
            lies in a folder that this project marked.
        steps, log_freq, logs: As for `train`.
        say: Takes the command line that is run.

    Returns:
        Steps that were done before.

    Raises:
        FileExistsError: If files are in `run` that no run of ours left there.
        RuntimeError: If it fails.
    """
    done = last_step(run)
    if done >= steps:
        say(f"The training's {done} steps are done.")
    elif done:
        checkpoint = run / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        resumed = [f"--config_path={checkpoint}", "--resume=true", f"--steps={steps}"]
        say(shown(resumed))
        train(resumed, steps, log_freq, logs, start=done)
    else:
        # Without a checkpoint there is nothing to go on with, and LeRobot wants the folder to be new.
        outputs.remove(run)
        say(shown(fresh))
        train(fresh, steps, log_freq, logs)
    return done


def read_curves(logs: Path, log_freq: int):
    """Training curves of a run and its resumptions, by name; see `training_log`."""
    found = []
    for path in sorted(logs.glob("train-*.log")):
        start = int(path.stem.removeprefix("train-"))
        text = path.read_text(errors="replace")
        found.append(TrainingLog(log_freq, step=start).read_all(split_output(text)))
    return joined(found)


def _log_path(logs: Path, start: int) -> Path:
    return logs / f"train-{start:06d}.log"


def _postfix(log: TrainingLog) -> str:
    values = [("loss", log.last("loss")), ("fk", log.last("fk_loss"))]
    return ", ".join(f"{name} {value:.3g}" for name, value in values if value is not None)
