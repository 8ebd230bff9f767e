"""`mimicik benchmark-loader`: samples a second of `lerobot-train` with and without whole-batch reading."""

import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from lerobot_mimicik.cli.options import parse

HELP = "Measure how many training samples a second are read, with and without whole-batch reading."


@dataclass
class BenchmarkLoaderConfig:
    """Runs stock `lerobot-train` twice on one dataset, with a network so small that reading dominates."""

    # Folder of a LeRobot dataset.
    dataset: Path
    # Samples in a batch.
    batch_size: int = 4096
    # Training steps with whole-batch reading; the first log window (start-up) is not counted.
    steps: int = 80
    # Samples in a batch without it: read one by one, large batches only take longer.
    baseline_batch_size: int = 256
    # Training steps without it.
    baseline_steps: int = 8
    # Loader processes of `lerobot-train`.
    num_workers: int = 0


_RATE = re.compile(r"smp/s:([0-9.]+)")


def samples_per_second(config: BenchmarkLoaderConfig, batched: bool) -> float:
    """Median over log windows of the rate that `lerobot-train` itself reports.

    Raises:
        RuntimeError: If `lerobot-train` fails or logs no rate; the message ends with what it printed.
    """
    steps = config.steps if batched else config.baseline_steps
    log_freq = max(1, steps // 4)
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "lerobot.scripts.lerobot_train",
            "--policy.type=mimicik",
            "--policy.push_to_hub=false",
            "--policy.device=cpu",
            f"--policy.batched_reads={str(batched).lower()}",
            "--policy.fk_weight=0",
            "--policy.n_layers=1",
            "--policy.d_model=16",
            "--policy.d_ff=16",
            f"--dataset.repo_id=local/{config.dataset.name}",
            f"--dataset.root={config.dataset}",
            f"--output_dir={folder}/run",
            f"--batch_size={config.batch_size if batched else config.baseline_batch_size}",
            f"--num_workers={config.num_workers}",
            f"--steps={steps}",
            f"--log_freq={log_freq}",
            "--save_checkpoint=false",
            "--env_eval_freq=0",
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    output = done.stdout + done.stderr
    rates = [float(rate) for rate in _RATE.findall(output)]
    if done.returncode or len(rates) < 2:
        raise RuntimeError(f"lerobot-train failed or logged no rate:\n{output[-4000:]}")
    settled = sorted(rates[1:])
    return settled[len(settled) // 2]


def main(argv: list[str]) -> None:
    """Parses the command line, measures and prints."""
    config = parse(BenchmarkLoaderConfig, argv, "mimicik benchmark-loader")
    if not (config.dataset / "meta" / "info.json").is_file():
        raise SystemExit(f"{config.dataset} is no LeRobot dataset: it has no meta/info.json")
    config.dataset = config.dataset.resolve()
    without = samples_per_second(config, batched=False)
    with_batches = samples_per_second(config, batched=True)
    print(f"lerobot-train, frame by frame:        {without:12,.0f} samples/s")
    print(f"lerobot-train, whole-batch reading:   {with_batches:12,.0f} samples/s")
    print(f"ratio:                                {with_batches / without:12.1f}")
