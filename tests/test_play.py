"""Playing with an arm: the session by itself, its page in a browser, and the command."""

import time

import numpy as np
import pytest
from evaluation_cases import Scripted, airbot

from lerobot_mimicik.cli import main as cli
from lerobot_mimicik.cli.play import PlayConfig, make_session
from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
from lerobot_mimicik.solvers import make_solver
from lerobot_mimicik.viewing.motions import Motion, generated_motions
from lerobot_mimicik.viewing.session import DRAG, FAILED, JUMPED, REACHED, PlaySession

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)


def session(motions=(), **more) -> PlaySession:
    """One whose solver is a damped least-squares step; others by name."""
    makers = {"least_squares": lambda: make_solver("least_squares", airbot())} | more
    played = PlaySession(ARM, makers, motions)
    played.choose(list(makers))
    return played


def moved(pose, by) -> np.ndarray:
    return np.concatenate([pose[:3] + by, pose[3:]])


def scripted(answer):
    return lambda: Scripted(answer)


def test_an_arm_goes_to_where_its_target_is_dragged():
    played = session()
    target = moved(played.target, [0.05, 0.03, -0.02])
    played.move_target(target)
    for _ in range(40):
        played.tick()
    reading = played.players["least_squares"].reading
    assert reading.status == REACHED
    assert reading.position_mm < 0.1
    np.testing.assert_allclose(
        played.model.pose(played.players["least_squares"].q)[:3], target[:3], atol=1e-4
    )
    played.restart()
    played.tick()
    np.testing.assert_allclose(played.players["least_squares"].q, HOME, atol=1e-6)


def test_what_is_no_pose_moves_no_target():
    played = session()
    for wrong in ([0.0] * 7, [np.nan] * 7, [0.3, 0, 0.3]):
        with pytest.raises(ValueError, match="7 finite numbers"):
            played.move_target(wrong)
    played.move_target([0.3, 0, 0.3, 0, 0, 0, 2.0])
    played.tick()
    np.testing.assert_allclose(played.target[3:], [0, 0, 0, 1])


def test_tremor_is_as_strong_as_asked_and_felt_as_jerk():
    played = session()
    for _ in range(30):
        played.tick()
    calm = played.players["least_squares"].reading.jerk
    played.tremor_mm = 2.0
    away = []
    for _ in range(600):
        played.tick()
        away.append(np.linalg.norm(played.target[:3] - played.clean[:3]))
    assert np.sqrt(np.mean(np.square(away))) == pytest.approx(2e-3, rel=0.02)
    assert played.players["least_squares"].reading.jerk > 100 * calm + 10


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        (lambda q, target, call: q + 0.5, JUMPED),
        (lambda q, target, call: q * np.nan, FAILED),
        (lambda q, target, call: 1 / 0, FAILED),
        (lambda q, target, call: np.clip(q - 0.099, airbot().lower.numpy(), None), "step bound"),
        (lambda q, target, call: q, "off target"),
    ],
)
def test_a_status_says_what_a_solver_does(answer, status):
    played = PlaySession(ARM, {"odd": scripted(lambda q, t, n: q if n == 0 else answer(q, t, n))})
    played.choose(["odd"])
    odd = played.players["odd"]
    odd.solver.answer = answer
    played.move_target(moved(played.target, [0.1, 0, 0]))
    played.tick()
    assert odd.reading.status == status
    assert np.isfinite(odd.q).all()
    assert bool(odd.reading.detail) == (status == FAILED)


def test_a_solver_that_cannot_be_made_leaves_its_reason_and_the_others():
    def broken():
        raise RuntimeError("needs another arm")

    played = session(broken=broken)
    assert list(played.players) == ["least_squares"]
    assert played.refused == {"broken": "needs another arm"}
    with pytest.raises(ValueError, match="offered are least_squares, broken"):
        played.choose(["no_such"])


def test_margins_are_1_in_the_middle_and_0_at_a_limit():
    lower, upper = airbot().lower.numpy(), airbot().upper.numpy()
    q = (lower + upper) / 2
    q[2] = upper[2]
    played = PlaySession(ARM, {"there": scripted(lambda *_: q)})
    played.choose(["there"])
    played.tick()
    np.testing.assert_allclose(played.players["there"].reading.margins, [1, 1, 0, 1, 1, 1], atol=1e-9)


def test_a_motion_begins_anew_and_a_recording_with_it_the_arms():
    targets = np.array([moved(airbot_pose(HOME), [0.01 * t, 0, 0]) for t in range(5)])
    played = session([Motion("line", HOME, targets, fps=10.0)])
    played.follow("line")
    assert played.fps == 10.0
    for frame in range(7):
        if frame == 5:
            assert np.abs(played.players["least_squares"].q - HOME).max() > 0.05
        played.tick()
        np.testing.assert_allclose(played.clean, targets[frame % 5])
    assert np.abs(played.players["least_squares"].q - HOME).max() < 0.05
    played.moving = False
    played.tick()
    np.testing.assert_allclose(played.clean, targets[1])
    played.move_target(targets[4])
    assert played.motion == DRAG
    with pytest.raises(ValueError, match="there are Drag the target, line"):
        played.follow("no such")


def test_a_solver_that_looks_ahead_is_told_the_targets_that_come():
    heard = []

    class Ahead(Scripted):
        look_ahead = 2

        def foresee(self, upcoming):
            heard.append(upcoming)

    targets = np.array([moved(airbot_pose(HOME), [0.001 * t, 0, 0]) for t in range(6)])
    played = session([Motion("line", HOME, targets)], ahead=lambda: Ahead(lambda q, *_: q))
    played.tick()
    assert not heard  # nobody knows where a hand goes
    played.follow("line")
    played.tick()
    played.tick()
    np.testing.assert_allclose(heard[-1], targets[2:4], atol=1e-12)


def airbot_pose(q) -> np.ndarray:
    return PlaySession(ARM, {}).model.pose(q)


def test_generated_motions_are_smooth_and_end_where_they_begin():
    motions = generated_motions(ARM)
    names = {motion.name for motion in motions}
    assert {
        "Circle",
        "Wrist singularity",
        "Elbow singularity",
        "Shoulder singularity",
        "Out of reach",
    } <= names
    for motion in motions:
        position = motion.targets[:, :3]
        closed = np.concatenate([position, position[:1]])
        assert np.linalg.norm(np.diff(closed, axis=0), axis=1).max() < 0.06, motion.name
        np.testing.assert_allclose(airbot_pose(motion.start)[:3], position[0], atol=0.02, err_msg=motion.name)


def test_the_command_names_what_does_not_fit(capsys, tmp_path):
    for wrong, told in (
        ("--arm=airbot_pley", "--arm: 'airbot_pley' is neither a shipped arm (airbot_play"),
        (f"--dataset={tmp_path}", "is not a LeRobot dataset"),
        ("--checkpoint=./nowhere", "./nowhere does not exist"),
        ("--tremor=-1", "expected 0 to 50 mm"),
        ("--episodes=a", "--episodes: 'a'"),
    ):
        assert cli.main(["play", wrong]) == 1
        assert told in capsys.readouterr().err
    with pytest.raises(ValueError, match="--solvers: limit cannot be played here: there are guided"):
        make_session(PlayConfig(solvers="limit"))


@pytest.mark.parametrize("name", SHIPPED_ARMS)
def test_every_shipped_arm_is_played_by_its_name(name):
    played = make_session(PlayConfig(arm=name, solvers="guided"))
    played.move_target(moved(played.target, [0.0, 0.01, 0.01]))
    for _ in range(10):
        played.tick()
    reading = played.players["guided"].reading
    assert reading.status == REACHED
    assert reading.position_mm < 0.1


def test_a_checkpoint_and_its_recordings_join_the_session(mimicik_run):
    played = make_session(
        PlayConfig(
            checkpoint=str(mimicik_run),
            dataset=str(mimicik_run.parent / "data" / "test"),
            episodes="0",
            solvers="mimicik,mimicik_guided,hold",
            motion="test, episode 0",
        )
    )
    for _ in range(3):
        played.tick()
    assert {player.reading.detail for player in played.players.values()} == {""}
    assert list(played.players) == ["mimicik", "mimicik_guided", "hold"]
    assert not (played.players["mimicik"].q == played.players["hold"].q).all()


def test_a_page_in_a_browser_follows_the_mouse():
    """The page loads, its user drags the target by its handle, the arm follows, and the console has no complaint."""
    pytest.importorskip("viser", reason="needs the extra play")
    from lerobot_mimicik.viewing.browser import Browser, find_chromium
    from lerobot_mimicik.viewing.page import PlayPage

    if find_chromium() is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    played = session(hold=lambda: make_solver("hold", airbot()))
    page = PlayPage(played, "test", port=0)
    try:
        with Browser(page.address, 720, 420) as browser:
            at = _shown(page, browser)
            start, before = played.target.copy(), played.players["least_squares"].q.copy()
            axis = _axis(start)
            for _ in range(3):  # a busy machine draws the handle later than the mouse is pressed
                _drag(page, browser, at, start[:3], _handle(played) * axis)
                if axis @ (played.target[:3] - start[:3]) > 0.02:
                    break
            for _ in range(40):
                page.tick()
            _play(page, browser, 1)
            way = played.target[:3] - start[:3]
            assert axis @ way > 0.02, "the target did not follow the mouse"
            assert np.linalg.norm(way - axis * (axis @ way)) < 1e-3
            assert np.abs(played.players["least_squares"].q - before).max() > 0.02
            assert np.abs(played.players["hold"].q - before).max() < 1e-12
            assert played.players["least_squares"].reading.position_mm < 1
            text = browser.evaluate("document.body.innerText")
            assert "least_squares" in text
            assert "reached" in text
            assert browser.errors == []
            browser.evaluate("console.error('a complaint')")
            assert browser.errors == ["a complaint"]
    finally:
        page.stop()


def _handle(played) -> float:
    """Length of the handle's arrows, m."""
    return 0.22 * played.model.reach


def _axis(pose) -> np.ndarray:
    """The tool's x axis."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(pose[3:]).as_matrix()[:, 0]


def _play(page, browser, frames: int) -> None:
    """So many frames, each drawn by the browser before the next."""
    for _ in range(frames):
        page.tick()
        browser.wait_for_drawing(0.02)


def _shown(page, browser):
    """Wait until a camera looks at the scene; a function from a point (3,) to where it is seen on the page, px."""
    until = time.monotonic() + 300  # no verdict, only an end
    while not (clients := page.server.get_clients()) or next(iter(clients.values())).camera.image_width == 0:
        assert time.monotonic() < until, "no browser connected"
        _play(page, browser, 1)
    _play(page, browser, 4)
    camera = next(iter(page.server.get_clients().values())).camera
    from scipy.spatial.transform import Rotation

    box = browser.evaluate(
        "(r => [r.x, r.y, r.width, r.height])(document.querySelector('canvas').getBoundingClientRect())"
    )
    into = Rotation.from_quat(camera.wxyz, scalar_first=True).inv()

    def seen(point):
        x, y, z = into.apply(point - camera.position)  # as OpenCV: x to the right, y down, z ahead
        focal = box[3] / 2 / np.tan(camera.fov / 2)
        return np.array([box[0] + box[2] / 2 + focal * x / z, box[1] + box[3] / 2 + focal * y / z])

    return seen


def _drag(page, browser, at, origin, handle):
    """Take the arrow `handle` (3,) at `origin` (3,) by its tip and pull it out to twice its length."""
    grip, end = at(origin + 0.9 * handle), at(origin + 2 * handle)
    browser.mouse("mouseMoved", *(grip - 3))
    browser.mouse("mouseMoved", *grip)
    _play(page, browser, 1)
    browser.mouse("mousePressed", *grip)
    for fraction in np.linspace(0, 1, 5):
        browser.mouse("mouseMoved", *(grip + fraction * (end - grip)))
        _play(page, browser, 1)
    browser.mouse("mouseReleased", *end)
    _play(page, browser, 2)
