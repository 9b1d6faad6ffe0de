"""The page of a session, and of a bag. No ROS is needed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from diffdrive_jacobian.live.bag_player import PERIOD, BagPlayer
from diffdrive_jacobian.live.recorded_runs import read_robots
from diffdrive_jacobian.live.server import LiveServer
from diffdrive_jacobian.live.session import Session
from diffdrive_jacobian.signals import Signals

Ready = Callable[[LiveServer], None]
"""Receives the server when it answers."""


@contextmanager
def serving(session: Session, port: int, ready: Ready) -> Iterator[LiveServer]:
    """Serve the page of a session.

    Args:
        session: The session.
        port: TCP port. 0: any free one.
        ready: Called when the server answers.

    Raises:
        OSError: The port is in use.
    """
    server = LiveServer(session, port)
    try:
        server.start()
        ready(server)
        yield server
    finally:
        server.close()


def watch_bag(path: Path, *, port: int, speed: float, signals: Signals, ready: Ready) -> None:
    """Play a bag on the page.

    Args:
        path: The bag.
        port: As for `serving`.
        speed: Speed at the start.
        signals: Counter of the signals that end it.
        ready: As for `serving`.

    Raises:
        BagError: It is not a bag, is damaged, or has no odometry.
        OSError: The port is in use.
    """
    session = Session()
    player = BagPlayer(session, path, read_robots(path), speed=speed)
    with serving(session, port, ready):
        while not signals.count:
            player.work()
            time.sleep(PERIOD)
