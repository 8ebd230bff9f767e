"""LeRobot's own commands, called as a user calls them, or inside this process to save its start of ten seconds."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

ONE_THREAD = {"OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}


def run_console(command: str, *options: str, timeout: float = 1500) -> str:
    """Runs a console command in a process of its own; what it printed. AssertionError if it fails."""
    done = subprocess.run(
        [str(Path(sys.executable).with_name(command)), *options],
        env={**os.environ, **ONE_THREAD},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    output = done.stdout + done.stderr
    assert done.returncode == 0, output[-6000:]
    return output


def run_here(module: str, *options: str) -> str:
    """Calls the `main` of a command's module, such as `lerobot.scripts.lerobot_train`; what it printed."""
    main = importlib.import_module(module).main
    printed, handlers, level = io.StringIO(), logging.root.handlers[:], logging.root.level
    try:
        with (
            mock.patch.object(sys, "argv", [module.rpartition(".")[2], *options]),
            contextlib.redirect_stdout(printed),
            contextlib.redirect_stderr(printed),
        ):
            main()
    except BaseException as error:
        error.add_note(printed.getvalue()[-6000:])
        raise
    finally:
        # The command sets up logging anew, to a stream that ends here.
        logging.root.handlers[:] = handlers
        logging.root.setLevel(level)
    return printed.getvalue()
