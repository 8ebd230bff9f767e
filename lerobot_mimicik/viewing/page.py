"""The page of `mimicik play`: a session drawn by viser, and what its user does put into the session.

viser calls back from threads of its own: what they bring waits in a queue until the next frame, so that only the loop's
thread touches the session.
"""

from __future__ import annotations

import contextlib
import io
import queue
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from lerobot_mimicik.solvers.base import solver_configuration
from lerobot_mimicik.viewing.numbers import card, refused_note
from lerobot_mimicik.viewing.scene import Colour, DrawnArm, Path, pose_of, wxyz_of
from lerobot_mimicik.viewing.session import DRAG, MOST_TREMOR_MM, PlaySession

COLOURS: tuple[Colour, ...] = (
    (42, 120, 214),
    (235, 104, 52),
    (27, 175, 122),
    (74, 58, 167),
    (232, 123, 164),
    (180, 130, 10),
)
"""Of the solvers, in the order in which they are offered; the first is the solid arm's."""

_TARGET: Colour = (60, 60, 60)
_PLOT_S = 10.0
_PLOT_EVERY, _NUMBERS_EVERY = 4, 4  # frames: five times a second is as fast as one reads
_LAST = 1e9  # in the order of the panel: the plot, which is made anew, comes before the list of solvers
_LEAST_MM = 1e-3  # bottom of the plot's logarithmic axis


class PlayPage:
    """A session in the browser."""

    def __init__(self, session: PlaySession, title: str, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Begin to serve; `run` or `tick` make it move.

        Args:
            session: What is played.
            title: Of the page.
            host: Address to listen on.
            port: Its port; the next free one where it is taken.
        """
        self.session = session
        self._waiting: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._arms: dict[str, DrawnArm] = {}
        self._colours: dict[str, Colour] = {}
        self._frames = 0
        with contextlib.redirect_stdout(io.StringIO()):  # its banner: the command has its own words
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        self._scene()
        self._controls(title)
        self._plot: viser.GuiUplotHandle | None = None
        self._errors: deque[tuple[float, ...]] = deque()
        self._chosen()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Play in real time, or as fast as the solvers allow."""
        due = time.monotonic()
        while not until():
            self.tick()
            due = max(due + 1 / self.session.fps, time.monotonic() - 0.1)
            time.sleep(max(0.0, due - time.monotonic()))

    def tick(self) -> None:
        """One frame: do what the user asked for, let the session go on, draw it."""
        while not self._waiting.empty():
            self._waiting.get()()
        session = self.session
        session.tick()
        self._frames += 1
        with self.server.atomic():
            for name, arm in self._arms.items():
                arm.show(session.players[name].q)
            self._asked.position, self._asked.wxyz = session.target[:3], wxyz_of(session.target)
            if session.motion != DRAG:
                self._handle.position, self._handle.wxyz = session.clean[:3], wxyz_of(session.clean)
            self._path.add(session.target[:3])
        self._record()
        if self._frames % _NUMBERS_EVERY == 0:
            self._numbers.content = self._cards_html()

    def stop(self) -> None:
        """End serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    # ---- what is drawn ----------------------------------------------------------------------------------------------

    def _scene(self) -> None:
        scene, reach = self.server.scene, self.session.model.reach
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=True)
        scene.add_grid(
            "/floor", 4 * reach, 4 * reach, cell_size=0.1, section_size=0.5,
            cell_color=(225, 225, 225), section_color=(195, 195, 195), shadow_opacity=0.2,
        )  # fmt: skip
        session = self.session
        at: dict[str, Any] = {"position": session.target[:3], "wxyz": wxyz_of(session.target)}
        self._asked = scene.add_frame("/asked", axes_length=0.1 * reach, axes_radius=0.006 * reach, **at)
        self._handle = scene.add_transform_controls("/target", scale=0.22 * reach, line_width=3.0, **at)
        self._path = Path(scene, "/asked_path", _TARGET, thickness=0.0015)

        @self._handle.on_update
        def _(event: viser.TransformControlsEvent) -> None:
            pose = pose_of(event.target.position, event.target.wxyz)
            self._waiting.put(lambda: self._dragged(pose))

        camera = self.server.initial_camera
        middle = 0.6 * session.target[:3]
        camera.look_at = middle
        camera.position = middle + reach * np.array([1.05, -1.25, 0.6])
        camera.fov = np.radians(45.0)

    def _controls(self, title: str) -> None:
        gui, session = self.server.gui, self.session
        gui.configure_theme(
            control_width="medium", show_logo=False, show_share_button=False, brand_color=COLOURS[0]
        )
        gui.main_panel.dock_right()
        gui.set_panel_label(title)
        with gui.add_folder("Target"):
            self._motion: Any = gui.add_dropdown(
                "follow", [DRAG, *session.motions], initial_value=session.motion
            )
            tremor = gui.add_slider(
                "tremor, mm", 0.0, max(MOST_TREMOR_MM, session.tremor_mm), 0.1, session.tremor_mm
            )
            moves = gui.add_checkbox("motion goes on", session.moving)
            again = gui.add_button("Start again")
        self._later(self._motion, lambda: self._follow(self._motion.value))
        self._later(tremor, lambda: setattr(session, "tremor_mm", float(tremor.value)))
        self._later(moves, lambda: setattr(session, "moving", bool(moves.value)))
        again.on_click(lambda _: self._waiting.put(self._restart))
        self._numbers = gui.add_html("")
        with gui.add_folder("Solvers", order=_LAST):
            self._boxes: dict[str, Any] = {
                name: gui.add_checkbox(name, name in session.players, hint=solver_configuration(name) or None)
                for name in session.offered
            }
        for box in self._boxes.values():
            self._later(box, self._choose)

    def _later(self, handle: Any, act: Callable[[], None]) -> None:
        """Act in the loop's thread when a user, not this program, changed a control."""
        handle.on_update(lambda event: self._waiting.put(act) if event.client is not None else None)

    # ---- what the user does -----------------------------------------------------------------------------------------

    def _dragged(self, pose: np.ndarray) -> None:
        self.session.move_target(pose)
        if self._motion.value != DRAG:
            self._motion.value = DRAG

    def _follow(self, name: str) -> None:
        self.session.follow(name)
        self._forget()

    def _restart(self) -> None:
        self.session.restart()
        target = (
            self.session.clean if self.session.motion != DRAG else self.session.model.pose(self.session.start)
        )
        self._handle.position, self._handle.wxyz = target[:3], wxyz_of(target)
        self._forget()

    def _choose(self) -> None:
        self.session.choose([name for name, box in self._boxes.items() if box.value])
        for name in self.session.refused:
            self._boxes[name].value = False
        self._chosen()

    def _chosen(self) -> None:
        """Draw the arms of the solvers that are chosen now: the first solid, the others as ghosts."""
        for arm in self._arms.values():
            arm.remove()
        session, scene = self.session, self.server.scene
        self._arms = {
            name: DrawnArm(scene, session.description, name, self._colour(name), number)
            for number, name in enumerate(session.players)
        }
        self._errors.clear()
        if self._plot is not None:
            self._plot.remove()
        self._plot = self._new_plot() if session.players else None

    def _forget(self) -> None:
        self._path.clear()
        for arm in self._arms.values():
            arm.forget()

    def _colour(self, name: str) -> Colour:
        # In the order in which they are first chosen, so that few solvers never share one.
        return self._colours.setdefault(name, COLOURS[len(self._colours) % len(COLOURS)])

    # ---- numbers ----------------------------------------------------------------------------------------------------

    def _cards_html(self) -> str:
        session, joints = self.session, self.session.description.joint_names
        cards = [
            card(name, self._colour(name), player.reading, joints, solver_configuration(name))
            for name, player in session.players.items()
            if player.reading is not None
        ]
        return "".join(cards) + refused_note(session.refused)

    def _new_plot(self) -> viser.GuiUplotHandle:
        series: list[Any] = [{}]
        for name in self.session.players:
            r, g, b = self._colour(name)
            series.append({"label": name, "stroke": f"rgb({r},{g},{b})", "width": 2})
        empty = np.array([0.0, 1.0])
        return self.server.gui.add_uplot(
            (empty, *(np.full(2, _LEAST_MM) for _ in self.session.players)),
            tuple(series),
            title="error, mm (last 10 s)",
            scales={"x": {"time": False}, "y": {"distr": 3}},
            axes=({"show": False}, {"ticks": {"show": False}, "grid": {"show": False}}),
            legend={"show": False},
            height=160,
            padding=(10, 10, 10, 0),
        )

    def _record(self) -> None:
        readings = [player.reading for player in self.session.players.values()]
        if self._plot is None or any(reading is None for reading in readings):
            return
        now = self._frames / self.session.fps
        self._errors.append((now, *(max(r.position_mm, _LEAST_MM) for r in readings if r is not None)))
        while self._errors[0][0] < now - _PLOT_S:
            self._errors.popleft()
        if self._frames % _PLOT_EVERY == 0 and len(self._errors) > 1:
            self._plot.data = tuple(np.array(self._errors).T)
