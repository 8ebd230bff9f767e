"""The arm that is led through its singularity, and the picture of it."""

import io

import numpy as np
import pytest
from PIL import Image

from lerobot_mimicik.cli.main import main
from lerobot_mimicik.evaluation.animation import animate
from lerobot_mimicik.evaluation.metrics import ESTOP_RAD, JOINT_SPIKE_RAD
from lerobot_mimicik.evaluation.plots import FONT, WIDTH, finished, new_figure
from lerobot_mimicik.evaluation.side_by_side import follow
from lerobot_mimicik.kinematics.arms import describe_arm


@pytest.fixture(scope="module")
def shown():
    return follow(describe_arm("airbot_play"))


def test_the_guided_solver_does_not_jump_where_the_other_would_stop_the_arm(shown):
    beside, ours = shown.followers
    assert shown.kind == "wrist"
    assert beside.steps.max() > ESTOP_RAD
    assert ours.steps.max() < JOINT_SPIKE_RAD / 2
    assert ours.error_mm.max() < 1
    assert beside.about[1:] in shown.sentence()


def test_the_picture_moves_and_is_legible_at_400_pixels(shown):
    animation = animate(shown, frames=3)
    with Image.open(io.BytesIO(animation.data)) as picture:
        assert picture.n_frames == 3
        frames = []
        for number in range(3):
            picture.seek(number)
            frames.append(np.array(picture.convert("L"), dtype=int))
        assert picture.width >= 400
    assert np.abs(frames[2] - frames[0]).max() > 50
    assert len(animation.data) < 300_000


def test_every_figure_has_type_of_nine_pixels_at_400():
    figure = new_figure(2.0)
    panel = figure.subplots()
    panel.plot([0, 1], [0, 1], label="a")
    panel.set(title="title", xlabel="x", ylabel="y")
    panel.legend()
    finished("one", "One", figure, "")
    texts = [*panel.get_xticklabels(), panel.title, panel.xaxis.label, *panel.get_legend().get_texts()]
    assert {text.get_fontsize() for text in texts} == {FONT}
    assert FONT * 400 / (72 * WIDTH) >= 9


def test_the_command_draws_the_picture_and_replaces_only_its_own(tmp_path, capsys):
    file = tmp_path / "wrist.gif"
    for _ in range(2):  # its own picture is drawn anew
        assert main(["demo", f"--picture={file}", "--arm=so101"]) == 0
        assert "elbow singularity" in capsys.readouterr().out
    file.write_bytes(b"GIF89a of somebody else")
    assert main(["demo", f"--picture={file}"]) == 1
    assert "--picture" in capsys.readouterr().err
    assert file.read_bytes() == b"GIF89a of somebody else"
