"""Reading training curves from what LeRobot's own tracker and progress bar print."""

import io

import pytest
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from tqdm import tqdm

from lerobot_mimicik.evaluation.training_log import TrainingLog, joined, split_output


def console_output(first, steps, log_freq, loss):
    """What `lerobot-train` writes to its console, by LeRobot's own formatting and tqdm's."""
    text = io.StringIO()
    meters = {"loss": AverageMeter("loss", ":.3f"), "lr": AverageMeter("lr", ":0.1e")}
    tracker = MetricsTracker(512, 10_000, 40, meters, initial_step=first)
    with tqdm(total=steps - first, desc="Training", unit="step", file=text, mininterval=0) as bar:
        for step in range(first + 1, steps + 1):
            tracker.loss, tracker.lr = loss(step), 1e-3
            tracker.update_metrics({"fk_loss": 2.0})
            tracker.step()
            bar.update(1)
            if step % log_freq == 0:
                text.write(f"INFO 2026-01-01 00:00:00 ot_train.py:641 {tracker}\n")
                tracker.reset_averages()
                text.write(
                    f"INFO 2026-01-01 00:00:00 ot_train.py:673 step {step}: eval_loss={step / 2:.4f}\n"
                )
    return text.getvalue()


def test_steps_and_values_are_recovered_although_the_step_is_printed_rounded():
    text = console_output(0, 1500, 50, loss=lambda step: 1000 / step)
    log = TrainingLog(50).read_all(split_output(text))
    assert log.curves["loss"].steps == list(range(50, 1501, 50))
    assert log.curves["loss"].values[-1] == pytest.approx(0.678, abs=1e-2)
    assert log.curves["fk_loss"].values == [2.0] * 30
    assert log.curves["lr"].values[0] == 1e-3
    assert log.curves["eval_loss"].steps == log.curves["loss"].steps
    assert log.step == 1500
    assert log.last("grdn") is None


def test_the_bar_alone_tells_the_step():
    log = TrainingLog(1000)
    assert log.read("Training:   3%|3         | 30/1000 [00:06<03:20,  4.83step/s]")
    assert log.step == 30
    assert not log.read("INFO something else")


def test_a_resumed_run_continues_the_curves_and_replaces_what_it_repeats():
    first = TrainingLog(10).read_all(split_output(console_output(0, 70, 10, loss=lambda step: 1.0)))
    second = TrainingLog(10, step=45).read_all(
        split_output(console_output(45, 100, 10, loss=lambda step: 2.0))
    )
    curve = joined([first, second])["loss"]
    assert curve.steps == list(range(10, 101, 10))
    assert curve.values == [1.0] * 4 + [2.0] * 6
    assert second.step == 100


def test_a_log_frequency_of_zero_is_refused():
    with pytest.raises(ValueError, match="log_freq"):
        TrainingLog(0)
