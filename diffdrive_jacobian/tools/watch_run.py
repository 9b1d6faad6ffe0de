"""Show running robots on a page in the browser and steer them, or play a bag there."""

from __future__ import annotations

import argparse
import errno
import os
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.live.server import LiveServer

PROGRAM = 'watch_run'
DISPLAYS = ('DISPLAY', 'WAYLAND_DISPLAY')
"""Environment variables without which no browser can open a window."""
STEERS = 'whoever knows this address can steer the robot; Ctrl-C ends'
PLAYS = 'the page plays the bag; Ctrl-C ends'


@_output.tool(PROGRAM)
def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    parser = _parser()
    options = parser.parse(arguments)
    if options.bag is None and options.rate is not None:
        parser.error('--rate needs a BAG: running robots have their own time')
    if options.bag is not None and options.ros:
        parser.error('a BAG needs no ROS arguments')
    with explaining_page_errors(options.port):
        (_watch_nodes if options.bag is None else _play)(options, signals)
    return DONE


def _play(options: argparse.Namespace, signals: Signals) -> None:
    from diffdrive_jacobian.live.bag_player import watch_bag

    print(f'reading {printable(options.bag, PATH_LIMIT)}', flush=True)
    ready, speed = announcing(options, notice=PLAYS), options.rate or 1.0
    watch_bag(options.bag, port=options.port, speed=speed, signals=signals, ready=ready)


def _watch_nodes(options: argparse.Namespace, signals: Signals) -> None:
    with long_lived(), signals.ending_at_once():
        from diffdrive_jacobian.live.node import watch_nodes

    ready = announcing(options)
    watch_nodes(ros_arguments=options.ros, port=options.port, signals=signals, ready=ready)


# --- The page of a tool


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


class PageError(UserError, NotDoneError):
    """The page cannot be served; nothing ran."""


@contextmanager
def explaining_page_errors(port: int) -> Iterator[None]:
    """Raise PageError where the given port cannot be used, or the module of the server is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] != 'websockets':
            raise
        raise PageError(
            "the page needs the Python module websockets: pip install 'diffdrive_jacobian[live]'"
        ) from error
    except OSError as error:
        why = {
            errno.EADDRINUSE: 'is in use: choose another one, or none for any free one',
            errno.EACCES: 'may not be used: choose one above 1023',
        }.get(error.errno or 0)
        if why is None or not port:
            raise
        raise PageError(f'--port {port} {why}') from error


def _rate(text: str) -> float:
    from diffdrive_jacobian.live.commands import MAX_WORLD_SPEED, MIN_WORLD_SPEED

    return _cli.number_that(between(MIN_WORLD_SPEED, MAX_WORLD_SPEED))(text)


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} [BAG] [options] [--ros-args ...]',
        description='Show running robots on a page in the browser: path, goal, wheels and the numbers '
        'of the Jacobian chain. The page also steers them. With BAG the page plays a recorded run. '
        'Ctrl-C ends. Exit code 0: ended by Ctrl-C; 1: the page cannot be served; 2: wrong arguments.',
    )
    parser.add_bag('bag to play (default: show running robots)', nargs='?')
    parser.add_value(
        '-r --rate', 'X', 'with BAG: how much faster than recorded it starts (default: 1.0)', kind=_rate
    )
    parser.add_page()
    return parser
