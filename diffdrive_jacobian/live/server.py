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

"""The server of the page: HTTP and websockets on 127.0.0.1, in a thread of its own.

If it is shared, guests reach it by another address of this machine, with a token of their own. They see
what the page shows, and steer only if that was given.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import io
import json
import logging
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Sequence
from enum import Enum
from functools import partial
from http import HTTPStatus
from importlib.resources import files
from typing import Any, TypeAlias

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from diffdrive_jacobian.live.commands import MAX_SIZE, CommandError, parse
from diffdrive_jacobian.live.session import Page, Session, Share
from diffdrive_jacobian.ros.rate_limit import TokenBucket

TYPES = {
    '.html': 'text/html; charset=utf-8',
    '.css': 'text/css; charset=utf-8',
    '.js': 'text/javascript; charset=utf-8',
    '.svg': 'image/svg+xml',
}
"""Content type by the ending of a file."""


def page_files() -> dict[str, tuple[str, bytes]]:
    """Return content type and content of every file of the page, by name."""
    found = {}
    for file in files('diffdrive_jacobian.live').joinpath('page').iterdir():
        ending = file.name[file.name.rfind('.') :]
        if ending in TYPES:
            found[file.name] = TYPES[ending], file.read_bytes()
    return found


HOSTS = ('127.0.0.1', 'localhost')
"""Names of this machine by which the page may be reached. The port may differ, as through ssh -L."""
HEADERS = {
    'Content-Security-Policy': "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    'Cross-Origin-Opener-Policy': 'same-origin',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Permissions-Policy': 'camera=(), geolocation=(), microphone=()',
    'Referrer-Policy': 'no-referrer',
    'X-Content-Type-Options': 'nosniff',
    'X-Frame-Options': 'DENY',
    'Cache-Control': 'no-store',
}
"""Sent with every answer. Nothing but the files of the page may be loaded, and no page may frame it."""
SOCKET = 'socket'
"""Name of the websocket below the token."""
OPEN = 'open'
"""Name of the address that is opened in the browser once, before its ticket."""
SHARE = 'share.svg'
"""Name of the QR code of a shared page."""


class Refusal(Enum):
    """Why a request is refused."""

    HOST = 'the Host is not this machine'
    ORIGIN = 'the request comes from another origin'
    TOKEN = 'the address has no valid token: use the one that the program printed'


class Access:
    """The secrets of one server, and the check of its requests."""

    def __init__(self, hosts: Sequence[str] = HOSTS) -> None:
        """Choose the secrets. `hosts` are the names by which the server may be reached."""
        self._hosts = re.compile(rf'({"|".join(map(re.escape, hosts))})(?::\d{{1,5}})?')
        self.token = secrets.token_urlsafe(24)
        """First part of every path."""
        self.ticket = secrets.token_urlsafe(24)
        """Second part of the path that redirects to the page, once."""

    def check(
        self, path: str, hosts: Sequence[str], origins: Sequence[str]
    ) -> tuple[str, str] | Refusal:
        """Check path, Host and Origin headers of a request.

        Returns:
            `('page', NAME)` for a file, `('socket', '')`, `('redirect', PATH)`, or why it is refused.
        """
        if len(hosts) != 1 or not self._hosts.fullmatch(hosts[0]):
            return Refusal.HOST
        if len(origins) > 1 or any(origin != f'http://{hosts[0]}' for origin in origins):
            return Refusal.ORIGIN
        first, _, name = path.partition('?')[0].removeprefix('/').partition('/')
        if first == OPEN and self._use_ticket(name):
            return 'redirect', f'/{self.token}/'
        if not _same(first, self.token):
            return Refusal.TOKEN
        if name != SOCKET:
            return 'page', name or 'index.html'
        # Browsers send the origin with every websocket.
        return ('socket', '') if origins else Refusal.ORIGIN

    def _use_ticket(self, ticket: str) -> bool:
        valid = bool(self.ticket) and _same(ticket, self.ticket)
        if valid:
            self.ticket = ''
        return valid


def _same(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode('utf-8', 'surrogateescape'), secret.encode())


ADDRESS = '127.0.0.1'
PERIOD = 0.04
"""Time between two states that a page receives (s)."""
GUEST_PERIOD = 0.1
"""The same of a guest: there may be a room full of them (s)."""
MAX_PAGES, MAX_GUESTS = 8, 64
"""Largest number of pages at once, of this machine and of guests."""
LOOK_ONLY = 'you may look, not steer: whoever shares this page has not given control'
COMMAND_RATE, COMMAND_BURST = 100.0, 200.0
"""Commands of a page per second, and at once. A page that sends more is disconnected."""
MAX_STRANGERS = 32
"""Largest number of connections at once without a websocket, and of those that wait to be accepted."""
GUESTS_TIMES = 12
"""How many times more of guests: a room opens the page at once, each browser by six connections."""
NOTICES, NOTICE_PERIOD = 5, 2.0
"""Notices about invalid commands at once, and the time after which there may be a further one (s)."""
MAX_INVALID = 20
"""Invalid commands after which a page is disconnected."""
PING_PERIOD = 2.0
"""Time between two pings, and the longest wait for the answer (s)."""
PATIENCE = 5.0
"""Longest wait for the thread of the server (s)."""
POLICY_VIOLATION, TRY_AGAIN_LATER = 1008, 1013
"""Codes with which a websocket is closed."""


class _Connection(ServerConnection):
    """A connection that is aborted if too many others come before it has shown the token.

    Otherwise they would exhaust the descriptors of the process, in which nodes may run.
    """

    def __init__(
        self,
        *args: Any,
        strangers: dict[ServerConnection, asyncio.Transport],
        times: int,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self._strangers, self._times = strangers, times

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        assert isinstance(transport, asyncio.Transport)
        self._strangers[self] = transport
        if len(self._strangers) > self._times * MAX_STRANGERS:
            # A browser has sent its request by now: the oldest one is none.
            oldest = next(iter(self._strangers))
            self._strangers.pop(oldest).abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._strangers.pop(self, None)
        super().connection_lost(exc)


class _Door:
    """One address at which the server listens, with its secrets and its guests."""

    def __init__(self, listening: socket.socket, access: Access, most: int, period: float) -> None:
        self.socket, self.access, self.most, self.period = listening, access, most, period
        self.may_steer, self.times = True, 1
        self.notices = TokenBucket(NOTICES, NOTICE_PERIOD)
        self.strangers: dict[ServerConnection, asyncio.Transport] = {}


class LiveServer:
    """Serves the page of a session, in a thread of its own, until it is closed."""

    def __init__(self, session: Session, port: int = 0, share: Share | None = None) -> None:
        """Listen on a TCP port (0: any free one), and if it is shared, at the same port of that address.

        Raises:
            OSError: The port is in use, or may not be used, or the address is none of this machine.
        """
        self._session = session
        self._files = page_files()
        self.access = Access()
        """The secrets in the addresses."""
        self._socket = socket.create_server((ADDRESS, port))
        self.port: int = self._socket.getsockname()[1]
        """TCP port."""
        self._doors = [_Door(self._socket, self.access, MAX_PAGES, PERIOD)]
        self.shared_url = ''
        """Address of the page for guests. Empty: it is not shared."""
        if share is not None:
            self._open_to_guests(share)
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name='live page', daemon=True)
        self._thread.start()

    def _open_to_guests(self, share: Share) -> None:
        version = socket.AF_INET6 if ':' in share.address else socket.AF_INET
        host = f'[{share.address}]' if version == socket.AF_INET6 else share.address
        try:
            listening = socket.create_server((share.address, self.port), family=version)
        except OSError:
            self._socket.close()
            raise
        door = _Door(listening, Access([host]), MAX_GUESTS, GUEST_PERIOD)
        # Nothing opens it in a browser.
        door.access.ticket = ''
        door.may_steer, door.times = share.control, GUESTS_TIMES
        self._doors.append(door)
        self.shared_url = f'http://{host}:{self.port}/{door.access.token}/'
        # It is for the page of this machine, but guests know it anyway.
        self._files[SHARE] = TYPES['.svg'], qr_code(self.shared_url)

    @property
    def url(self) -> str:
        """Address of the page. Whoever knows it can steer the robots."""
        return f'http://{ADDRESS}:{self.port}/{self.access.token}/'

    @property
    def opening_url(self) -> str:
        """Address that leads to the page once.

        It is for the command line of a browser, which other users of the machine can read.
        """
        return f'http://{ADDRESS}:{self.port}/{OPEN}/{self.access.ticket}'

    def close(self) -> None:
        """Disconnect all pages and end the thread."""
        # The loop is closed if the thread has ended.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join(PATIENCE)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        logger = logging.getLogger('diffdrive_jacobian.live')
        # Who cannot connect is told so. Nothing of that is for the terminal.
        logger.addHandler(logging.NullHandler())
        logger.propagate = False
        servers = [await self._listen(door, logger) for door in self._doors]
        await self._closing.wait()
        for server in servers:
            server.close()
        for door in self._doors:
            for transport in door.strangers.values():
                transport.abort()
        with contextlib.suppress(asyncio.TimeoutError):
            waits = (server.wait_closed() for server in servers)
            await asyncio.wait_for(asyncio.gather(*waits), 0.5)

    async def _listen(self, door: _Door, logger: logging.Logger) -> Server:
        # Typed as a class, but any factory does.
        factory: Any = partial(_Connection, strangers=door.strangers, times=door.times)
        server: Server = await serve(
            partial(self._handle, door),
            sock=door.socket,
            backlog=door.times * MAX_STRANGERS,
            create_connection=factory,
            process_request=partial(self._answer, door),
            compression=None,
            max_size=MAX_SIZE,
            max_queue=8,
            open_timeout=PATIENCE,
            ping_interval=PING_PERIOD,
            ping_timeout=PING_PERIOD,
            close_timeout=0.2,
            server_header=None,
            logger=logger,
        )
        return server

    def _answer(self, door: _Door, connection: ServerConnection, request: Request) -> Response | None:
        """Return the answer to a request. None: it may open the websocket."""
        headers = request.headers
        found = door.access.check(request.path, headers.get_all('Host'), headers.get_all('Origin'))
        if isinstance(found, Refusal):
            return _response(
                HTTPStatus.FORBIDDEN, 'text/plain; charset=utf-8', f'{found.value}\n'.encode()
            )
        kind, name = found
        if kind == 'redirect':
            return _response(HTTPStatus.SEE_OTHER, 'text/plain', b'', Location=name)
        if kind == 'socket':
            door.strangers.pop(connection, None)
            return None
        if name not in self._files:
            return _response(HTTPStatus.NOT_FOUND, 'text/plain', b'there is no such file\n')
        response = _response(HTTPStatus.OK, *self._files[name])
        if door is not self._doors[0]:
            # Browsers ignore it without TLS, and complain.
            del response.headers['Cross-Origin-Opener-Policy']
        return response

    async def _handle(self, door: _Door, connection: ServerConnection) -> None:
        if len(connection.server.connections) > door.most:
            await connection.close(TRY_AGAIN_LATER, f'{door.most} pages are open already')
            return
        page = self._session.enter()
        sending = asyncio.ensure_future(self._send(door, connection, page))
        try:
            with contextlib.suppress(ConnectionClosed):
                await self._receive(door, connection, page)
        finally:
            # First, because driving by hand ends with it.
            self._session.leave(page)
            sending.cancel()

    async def _send(self, door: _Door, connection: ServerConnection, page: Page) -> None:
        shared = self.shared_url if door is self._doors[0] else ''
        given = self._doors[-1].may_steer
        may: dict[str, Any] = {'steer': door.may_steer, 'shared': shared, 'guests_steer': given}
        with contextlib.suppress(ConnectionClosed):
            while True:
                frame = page.frame(self._session)
                if frame is not None:
                    if may:
                        # Once.
                        frame, may = {**frame, 'may': may}, {}
                    # Waits while the page does not read; then the latest state is sent.
                    await connection.send(json.dumps(frame, allow_nan=False, separators=(',', ':')))
                await asyncio.sleep(door.period)

    async def _receive(self, door: _Door, connection: ServerConnection, page: Page) -> None:
        limit = TokenBucket(COMMAND_BURST, 1.0 / COMMAND_RATE)
        invalid = 0
        async for text in connection:
            if not limit.permits(time.monotonic()):
                await connection.close(
                    POLICY_VIOLATION, f'more than {COMMAND_RATE:g} commands per second'
                )
                return
            if not door.may_steer:
                # The page of a guest has nothing to send them by: it is another program.
                await connection.close(POLICY_VIOLATION, LOOK_ONLY)
                return
            try:
                command = parse(text)
            except CommandError as error:
                invalid += 1
                if invalid >= MAX_INVALID:
                    await connection.close(POLICY_VIOLATION, f'{invalid} invalid commands')
                    return
                if door.notices.permits(time.monotonic()):
                    self._session.notify(f'command refused: {error}', 'error')
                continue
            if not self._session.put(page, command):
                self._session.notify('too many commands are waiting: this one was dropped', 'warning')


def qr_code(text: str) -> bytes:
    """Return a QR code as SVG, of the size that the page gives it.

    Raises:
        ModuleNotFoundError: segno is not installed.
    """
    import segno

    content = io.BytesIO()
    code = segno.make(text, micro=False)
    code.save(content, kind='svg', omitsize=True, border=2, dark='#000', light='#fff')
    return content.getvalue()


Ready: TypeAlias = Callable[[LiveServer], None]
"""Receives a server when it answers."""


def _response(status: HTTPStatus, kind: str, body: bytes, **more: str) -> Response:
    headers = Headers({'Content-Type': kind, 'Content-Length': str(len(body)), **HEADERS, **more})
    headers['Connection'] = 'close'
    return Response(status.value, status.phrase, headers, body)
