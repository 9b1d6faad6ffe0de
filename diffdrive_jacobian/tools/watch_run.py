# Copyright 2026 The diffdrive_jacobian developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Show running robots on a page in the browser and steer them, or play a bag there."""

from __future__ import annotations

import argparse
import errno
import os
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from diffdrive_jacobian.errors import NotDoneError, UserError
from diffdrive_jacobian.numerics.checks import between
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.text import PATH_LIMIT, printable
from diffdrive_jacobian.tools import _cli, _output
from diffdrive_jacobian.tools.entry_points import DONE, long_lived

if TYPE_CHECKING:
    from diffdrive_jacobian.live.server import LiveServer
    from diffdrive_jacobian.live.session import Share

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
    share = parser.given_share(options)
    with explaining_page_errors(options):
        (_watch_nodes if options.bag is None else _play)(options, signals, share)
    return DONE


def _play(options: argparse.Namespace, signals: Signals, share: Share | None) -> None:
    from diffdrive_jacobian.live.bag_player import watch_bag

    print(f'reading {printable(options.bag, PATH_LIMIT)}', flush=True)
    ready, speed = announcing(options, notice=PLAYS), options.rate or 1.0
    page: dict[str, Any] = {'port': options.port, 'signals': signals, 'ready': ready, 'share': share}
    watch_bag(options.bag, speed=speed, **page)


def _watch_nodes(options: argparse.Namespace, signals: Signals, share: Share | None) -> None:
    with long_lived(), signals.ending_at_once():
        from diffdrive_jacobian.live.node import watch_nodes

    ready = announcing(options)
    page: dict[str, Any] = {'port': options.port, 'signals': signals, 'ready': ready, 'share': share}
    watch_nodes(ros_arguments=options.ros, **page)


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
        if server.shared_url:
            _announce_guests(server, control=options.share_control)
        if not options.no_browser and any(map(os.environ.get, DISPLAYS)):
            # Starting a browser may take seconds.
            arguments = (server.opening_url,)
            threading.Thread(target=webbrowser.open, args=arguments, daemon=True).start()

    return announce


def _announce_guests(server: LiveServer, *, control: bool) -> None:
    """Print the address for guests, also as a code that phones read."""
    import segno

    print(f'guests: {server.shared_url}')
    may = 'can STEER the robots' if control else 'can look'
    print(f'whoever knows that address {may}; what is sent is not encrypted', flush=True)
    if sys.stdout.isatty():
        segno.make(server.shared_url, micro=False).terminal(compact=True)


class PageError(UserError, NotDoneError):
    """The page cannot be served; nothing ran."""


@contextmanager
def explaining_page_errors(options: argparse.Namespace) -> Iterator[None]:
    """Raise PageError where the port or the address cannot be used, or a module is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or '').split('.')[0]
        if module not in ('websockets', 'segno'):
            raise
        raise PageError(
            f"the page needs the Python module {module}: pip install 'diffdrive_jacobian[live]'"
        ) from error
    except OSError as error:
        port = options.port
        if error.errno == errno.EADDRNOTAVAIL and options.share is not None:
            raise PageError(
                f'--share {options.share} is no address of this machine, which has '
                f'{", ".join(_addresses()) or "none"}'
            ) from error
        why = {
            errno.EADDRINUSE: 'is in use: choose another one, or none for any free one',
            errno.EACCES: 'may not be used: choose one above 1023',
        }.get(error.errno or 0)
        if why is None or not port:
            raise
        raise PageError(f'--port {port} {why}') from error


def _addresses() -> list[str]:
    """Return addresses of this machine by which others may reach it, as far as they are known."""
    # Slow to import.
    import ipaddress
    import socket

    found = set()
    with suppress(OSError):
        found = {str(one[4][0]) for one in socket.getaddrinfo(socket.gethostname(), None)}
    # The one by which it would reach others; nothing is sent.
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(('192.0.2.1', 9))
        found.add(str(probe.getsockname()[0]))
    return sorted(one for one in found if not ipaddress.ip_address(one.partition('%')[0]).is_loopback)


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
