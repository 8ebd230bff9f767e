"""A page in the browser that shows an arm as it moves, and its tool's path. Needs the extra `play`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lerobot_mimicik.kinematics.arms import ArmDescription

_COLOUR = (230, 126, 34)


class ArmPage:
    """One arm on a page of its own; `show` draws it."""

    def __init__(self, description: ArmDescription, port: int = 8080, host: str = "127.0.0.1") -> None:
        """Serves the page at a port, or the next free one.

        Raises:
            ModuleNotFoundError: Without viser; the message names the extra.
        """
        try:
            import viser
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "the page needs viser: install the extra with pip install 'lerobot_policy_mimicik[play]'"
            ) from error
        from lerobot_mimicik.viewing.scene import DrawnArm

        self._server = viser.ViserServer(host=host, port=port, label="arm", verbose=False)
        self._server.scene.set_up_direction("+z")
        self._server.scene.add_grid("/floor", width=2.0, height=2.0, cell_size=0.1)
        self._arm = DrawnArm(self._server.scene, description, "arm", _COLOUR)
        self.address = f"http://{host}:{self._server.get_port()}"

    def show(self, q: ArrayLike) -> None:
        """Draw the arm with joints (dof,) [rad]."""
        self._arm.show(np.asarray(q, dtype=float))

    def close(self) -> None:
        """Take the page away."""
        self._server.stop()
