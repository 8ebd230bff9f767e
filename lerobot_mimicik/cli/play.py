"""`mimicik play`: an arm in the browser, a target to drag, and solvers that follow it side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from lerobot_mimicik.cli.options import numbers, parse, words
from lerobot_mimicik.kinematics.names import did_you_mean

if TYPE_CHECKING:
    from lerobot_mimicik.kinematics.arms import ArmDescription
    from lerobot_mimicik.viewing.page import PlayPage
    from lerobot_mimicik.viewing.session import PlaySession

HELP = (
    "Play with an arm in the browser: drag its target, compare solvers, watch error, jerk and singularities."
)

# Those that cannot follow a hand: one knows the future, one is another process's.
_NOT_PLAYED = ("limit", "remote")
_SIGNATURE = "mimicik play"
_PICTURE_SIZE = (1280, 860)
_PICTURE_S = 5.0  # of motion before a picture, so that paths and plot show something


@dataclass
class PlayConfig:
    """Options of `mimicik play`, e.g. `mimicik play --arm=piper --solvers=guided,least_squares,mink`."""

    # A shipped arm, or the path of a URDF; empty: the checkpoint's, else the dataset's, else airbot_play.
    arm: str = ""
    # Last link of the arm, where the URDF has several ends; empty: its only one.
    tip_link: str = ""
    # Who follows from the start, the first one as the solid arm; the page offers all that are installed.
    solvers: str = "guided,least_squares"
    # A checkpoint's folder, a training run's, or a Hub repository: its network joins the solvers.
    checkpoint: str = ""
    # Folder of a LeRobot dataset whose episodes can be followed.
    dataset: str = ""
    # Its episodes, as numbers and ranges such as 0-9,12; empty: the first ten.
    episodes: str = ""
    # The motion to begin with (Circle, Wrist singularity, ...); empty: the target is dragged.
    motion: str = ""
    # Trembling of the target, root mean square in mm (half a degree per mm goes with it).
    tremor: float = 0.0
    # Address to listen on; 0.0.0.0 lets other computers in.
    host: str = "127.0.0.1"
    # Its port; the next free one where it is taken.
    port: int = 8080
    # Take a picture (PNG) after some seconds with a headless Chromium, and end.
    screenshot: str = ""


def main(argv: Sequence[str]) -> int:
    """Run the command."""
    config = parse(PlayConfig, argv, "mimicik play")
    _check(config)
    print("Preparing the arm and its solvers ...", flush=True)
    try:
        import viser  # noqa: F401 - said before seconds go into the rest
    except ModuleNotFoundError as error:
        raise RuntimeError(
            f"{error.name} is not installed: uv pip install 'lerobot_policy_mimicik[play]'"
        ) from error
    page = make_page(config)
    try:
        if config.screenshot:
            take_picture(page, config.screenshot)
            print(f"Picture: {config.screenshot}")
        else:
            print(f"Open {page.address} in a browser; Ctrl-C stops.", flush=True)
            page.run()
    finally:
        page.stop()
    return 0


def make_page(config: PlayConfig) -> PlayPage:
    """The page that the options describe, served but not yet moving; errors as `make_session`."""
    from lerobot_mimicik.kinematics.urdf import read_urdf
    from lerobot_mimicik.viewing.page import PlayPage

    session = make_session(config)
    return PlayPage(
        session, f"MimicIK · {read_urdf(session.description.urdf).name}", config.host, config.port
    )


def make_session(config: PlayConfig) -> PlaySession:
    """The session that the options describe.

    Raises:
        ValueError: An option does not fit; the message names it and what exists.
    """
    import torch

    from lerobot_mimicik.kinematics.chain import SerialArm
    from lerobot_mimicik.viewing.motions import generated_motions, recorded_motions
    from lerobot_mimicik.viewing.session import PlaySession

    description, policy = _arm_and_policy(config)
    arm = SerialArm(description, dtype=torch.float64)
    motions = generated_motions(description)
    if config.dataset:
        motions += recorded_motions(config.dataset, arm, numbers(config.episodes, "--episodes"))
    session = PlaySession(description, _offered(arm, policy), motions)
    names = words(config.solvers)
    unknown = [name for name in names if name not in session.offered]
    if unknown:
        from lerobot_mimicik.solvers import available_solvers

        why = available_solvers().get(unknown[0]) or f"there are {', '.join(session.offered)}"
        raise ValueError(
            f"--solvers: {unknown[0]} cannot be played here: {why}."
            + did_you_mean(unknown[0], session.offered)
        )
    session.choose(names)
    if session.refused:
        name, reason = next(iter(session.refused.items()))
        raise ValueError(f"--solvers: {name} does not take this arm: {reason}")
    if config.motion:
        found = [name for name in session.motions if name.lower() == config.motion.lower()]
        if not found:
            raise ValueError(
                f"--motion: unknown {config.motion!r}; there are {', '.join(session.motions)}."
                + did_you_mean(config.motion, session.motions)
            )
        session.follow(found[0])
    session.tremor_mm = config.tremor
    return session


def take_picture(page: PlayPage, path: str) -> None:
    """Play until there is something to see, in a headless Chromium, and write its picture.

    Raises:
        FileNotFoundError: No Chromium is installed.
        RuntimeError: The page complained.
    """
    from lerobot_mimicik.viewing.browser import Browser

    with Browser(page.address, *_PICTURE_SIZE) as browser:
        while not browser.evaluate("document.querySelector('canvas') !== null"):
            page.tick()
        for _ in range(round(_PICTURE_S * page.session.fps)):
            page.tick()
            browser.evaluate("0")
        # Chromium without a graphics card makes viser warn of slowness.
        browser.evaluate(
            "document.querySelectorAll('.mantine-Notification-closeButton').forEach(x => x.click())"
        )
        browser.wait_for_drawing()
        browser.picture(path)
        _sign(path)
        if browser.errors:
            raise RuntimeError(f"the page complained: {browser.errors[0]}")


def _sign(path: str) -> None:
    """Note in a picture that it was taken here: such a file may be replaced."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    note = PngInfo()
    note.add_text("Software", _SIGNATURE)
    with Image.open(path) as picture:
        picture.save(path, pnginfo=note)


def _check(config: PlayConfig) -> None:
    """Say what does not fit before seconds go into imports."""
    from lerobot_mimicik.checkpoints import find_checkpoint
    from lerobot_mimicik.inputs import check_dataset, near
    from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, describe_arm
    from lerobot_mimicik.outputs import check_file

    if config.arm and config.arm not in SHIPPED_ARMS:
        try:
            describe_arm(config.arm, tip_link=config.tip_link or None)
        except ValueError as error:
            raise ValueError(f"--arm: {error}{near(config.arm)}") from error
    if config.checkpoint:
        find_checkpoint(config.checkpoint)
    if config.dataset:
        check_dataset(config.dataset, "--dataset")
    numbers(config.episodes, "--episodes")
    if config.screenshot:
        check_file(config.screenshot, "--screenshot", _SIGNATURE.encode())
    if not 0 <= config.tremor <= 50:  # 5 cm is no tremor any more
        raise ValueError(f"--tremor={config.tremor:g}: expected 0 to 50 mm")
    if not 0 <= config.port < 65536:
        raise ValueError(f"--port={config.port}: expected 0 to 65535")


def _arm_and_policy(config: PlayConfig) -> tuple[ArmDescription, Any]:
    """The arm, with a home, and the checkpoint's policy or None."""
    from lerobot_mimicik.data.home import with_home
    from lerobot_mimicik.kinematics.arms import arm_of_dataset, describe_arm

    policy = None
    if config.checkpoint:
        from lerobot_mimicik.checkpoints import load_policy

        policy = load_policy(config.checkpoint)
    description = describe_arm(config.arm, tip_link=config.tip_link or None) if config.arm else None
    if description is None and policy is not None:
        description = policy.config.arm_description()
    if description is None and config.dataset:
        description = arm_of_dataset(config.dataset)
    return with_home(description or describe_arm("airbot_play")), policy


def _offered(arm: Any, policy: Any) -> dict[str, Any]:
    """What makes each solver that can be played here, by name: the guided ones first."""
    from lerobot_mimicik.checkpoints import LEARNED, kind_of
    from lerobot_mimicik.solvers import available_solvers, make_solver

    learned = (*LEARNED, "mimicik_guided")
    here = [name for name, why in available_solvers().items() if why is None and name not in _NOT_PLAYED]
    names = [name for name in here if name not in learned]
    names.sort(key=lambda name: (not name.startswith("guided"), name == "hold", name))
    makers: dict[str, Any] = {name: partial(make_solver, name, arm) for name in names}
    if policy is not None:
        for name in (kind_of(policy.config), "mimicik_guided"):
            makers[name] = partial(make_solver, name, arm, policy=policy)
    return makers
