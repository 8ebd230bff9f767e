"""Two serial ports joined by a wire, made of pseudo-terminals, for python-can's slcan interface at both ends.

A serial-line CAN adapter writes a frame that it received just as it is told to send one (tIIILDD...), so that two
programs that each talk to an adapter can as well talk to each other.
"""

from __future__ import annotations

import contextlib
import os
import select
import tty
from collections.abc import Iterator
from multiprocessing import get_context


@contextlib.contextmanager
def joined_ports() -> Iterator[tuple[str, str]]:
    """The paths of two serial ports; what is written to one is read from the other. A process joins them."""
    masters, paths, slaves = [], [], []
    for _ in range(2):
        master, slave = os.openpty()
        tty.setraw(slave)
        masters.append(master)
        slaves.append(slave)  # kept open: a port that nobody has open would end the wire
        paths.append(os.ttyname(slave))
    wire = get_context("fork").Process(target=_carry, args=tuple(masters), daemon=True)
    wire.start()
    try:
        yield paths[0], paths[1]
    finally:
        wire.terminate()
        wire.join()
        for descriptor in (*masters, *slaves):
            os.close(descriptor)


def _carry(one: int, other: int) -> None:
    to = {one: other, other: one}
    while True:
        for ready in select.select([one, other], [], [])[0]:
            os.write(to[ready], os.read(ready, 4096))
