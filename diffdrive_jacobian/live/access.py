"""Who may use the server: a secret path, and checks of Host and Origin.

Every address begins with a random token, `http://127.0.0.1:PORT/TOKEN/`. There is no cookie, because
browsers send those of one port of 127.0.0.1 to all others, too. A page of another origin knows neither
the token nor may it open the websocket. A name that an attacker lets point to 127.0.0.1 (DNS rebinding)
is refused by the check of Host.
"""

from __future__ import annotations

import hmac
import re
import secrets
from collections.abc import Sequence
from enum import Enum

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
_HOST = re.compile(rf'({"|".join(map(re.escape, HOSTS))})(?::\d{{1,5}})?')


class Refusal(Enum):
    """Why a request is refused."""

    HOST = 'the Host is not this machine'
    ORIGIN = 'the request comes from another origin'
    TOKEN = 'the address has no valid token: use the one that the program printed'


class Access:
    """The secrets of one server, and the check of its requests."""

    def __init__(self) -> None:
        """Choose the secrets."""
        self.token = secrets.token_urlsafe(24)
        """First part of every path."""
        self._ticket = secrets.token_urlsafe(24)

    @property
    def opening_path(self) -> str:
        """Path that redirects to the page, once.

        A browser is started with it. Its command line can be read by other users of the machine, but is
        worthless after the first use.
        """
        return f'/{OPEN}/{self._ticket}'

    def check(
        self, path: str, hosts: Sequence[str], origins: Sequence[str]
    ) -> tuple[str, str] | Refusal:
        """Return what is requested.

        Args:
            path: Path of the request, with its query.
            hosts: Values of the header Host.
            origins: Values of the header Origin.

        Returns:
            `('page', NAME)` for a file, `('socket', '')`, `('redirect', PATH)`, or why it is refused.
        """
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
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
        valid = bool(self._ticket) and _same(ticket, self._ticket)
        if valid:
            self._ticket = ''
        return valid


def _same(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode('utf-8', 'surrogateescape'), secret.encode())
