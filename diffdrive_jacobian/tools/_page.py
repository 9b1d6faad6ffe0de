"""The page of a tool in the browser: its address, and what prevents that it is served."""

from __future__ import annotations

import argparse
import errno
import os
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from diffdrive_jacobian.errors import UserError

if TYPE_CHECKING:
    from diffdrive_jacobian.live.server import LiveServer

DISPLAYS = ('DISPLAY', 'WAYLAND_DISPLAY')
"""Environment variables without which no browser can open a window."""
MISSING = "the page needs the Python module websockets: pip install 'diffdrive_jacobian[live]'"

STEERS = 'whoever knows this address can steer the robot; Ctrl-C ends'
PLAYS = 'the page plays the bag; Ctrl-C ends'
DRIVES = 'whoever knows this address can steer the robot; it goes on after the goals, until Ctrl-C'
"""Last line that a tool prints about its page."""


def announcing(
    options: argparse.Namespace, waiting: str = '', notice: str = STEERS
) -> Callable[[LiveServer], None]:
    """Return a function that prints the address of a server, and opens it in a browser.

    Args:
        options: The options of the page.
        waiting: What happens when the page is open. Empty: nothing in particular.
        notice: The last line: what the page can do, and how it ends.
    """

    def announce(server: LiveServer) -> None:
        print(f'page: {server.url}')
        if waiting:
            print(f'{waiting} when the page is open')
        print(notice, flush=True)
        if not options.no_browser and any(map(os.environ.get, DISPLAYS)):
            # Starting a browser may take seconds.
            arguments = (server.opening_url,)
            threading.Thread(target=webbrowser.open, args=arguments, daemon=True).start()

    return announce


class PageError(UserError):
    """The page cannot be served."""


@contextmanager
def explaining_page_errors(port: int) -> Iterator[None]:
    """Raise PageError where the given port cannot be used, or the module of the server is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] != 'websockets':
            raise
        raise PageError(MISSING) from error
    except OSError as error:
        message = _port_message(error, port)
        if message is None:
            raise
        raise PageError(message) from error


def _port_message(error: OSError, port: int) -> str | None:
    """Return what to print if a port cannot be used. None: the error is another one."""
    reasons = {
        errno.EADDRINUSE: 'is in use: choose another one, or none for any free one',
        errno.EACCES: 'may not be used: choose one above 1023',
    }
    why = reasons.get(error.errno or 0)
    return None if why is None or not port else f'--port {port} {why}'
