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

"""The server of the live page: who may use it, and what it withstands."""

from __future__ import annotations

import contextlib
import http.client
import json
import select
import socket
import time

import pytest
from chromium import until
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from diffdrive_jacobian.live import server as live_server
from diffdrive_jacobian.live.commands import DriveByHand
from diffdrive_jacobian.live.server import (
    MAX_INVALID,
    Access,
    LiveServer,
    Refusal,
)
from diffdrive_jacobian.live.session import Session, Share, Snapshot

DRIVE = json.dumps({'do': 'drive', 'robot': '/', 'v': 0.2, 'omega': 0.0})


GUESTS = '127.0.0.2'
"""An address of this machine, as guests use one."""


class Doors:
    """A server, and the address and the token by which a test reaches it."""

    def __init__(self, share=None):
        self.server = LiveServer(Session(), share=share)
        self.port = self.server.port
        door = self.server._doors[-1]
        self.host, self.token = (GUESTS if share else '127.0.0.1'), door.access.token
        self.most, self.times = door.most, door.times

    def close(self):
        self.server.close()
        assert not self.server._thread.is_alive()


@pytest.fixture(params=['own', 'guests'])
def server(request):
    """A server, reached by its own address, or by that of guests to whom control was given."""
    doors = Doors(Share(GUESTS, control=True) if request.param == 'guests' else None)
    yield doors
    doors.close()


@pytest.fixture
def own():
    doors = Doors()
    yield doors
    doors.close()


@pytest.fixture
def guests():
    """A server that is shared with guests who may only look, reached by their address."""
    doors = Doors(Share(GUESTS))
    yield doors
    doors.close()


def session_of(server):
    return server.server._session


def get(server, path, **headers):
    """Request a path; return status, headers and body."""
    connection = http.client.HTTPConnection(server.host, server.port, timeout=20)
    with contextlib.closing(connection):
        connection.putrequest('GET', path, skip_host='Host' in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def page(server, *, path=None, **headers):
    """Open the websocket, as a page of some origin would."""
    own = f'{server.host}:{server.port}'
    return connect(
        f'ws://{headers.get("host", own)}{path or f"/{server.token}/socket"}',
        origin=headers.get('origin', f'http://{own}'),
        sock=socket.create_connection((server.host, server.port), timeout=20),
        proxy=None,
        open_timeout=20,
    )


# --- Access

OWN = '127.0.0.1:8000'
FORWARDED = 'localhost:9000'


def test_the_token_gives_access_to_page_and_socket():
    access = Access()
    for path, found in (
        ('', ('page', 'index.html')),
        ('main.js', ('page', 'main.js')),
        ('theme.css?x=1', ('page', 'theme.css')),
        ('socket', ('socket', '')),
    ):
        for host in (OWN, FORWARDED):
            assert access.check(f'/{access.token}/{path}', [host], [f'http://{host}']) == found
    assert len(access.token) >= 32
    assert access.token != Access().token


def test_others_have_no_access():
    """A page of evil.example may come with a name that now leads to 127.0.0.1: DNS rebinding."""
    access = Access()
    for path in ('', 'index.html', 'x/main.js', '/', 'open/', 'open/x', 'socket', '\udcff/'):
        assert access.check(f'/{path}', [OWN], []) is Refusal.TOKEN, path
    page, socket = f'/{access.token}/', f'/{access.token}/socket'
    for host in ('evil.example', '127.0.0.1.evil.example', '127.0.0.1@evil', '10.0.0.1', ''):
        assert access.check(page, [host], []) is Refusal.HOST, host
        assert access.check(socket, [host], [f'http://{host}']) is Refusal.HOST, host
    assert access.check(page, [OWN, OWN], []) is Refusal.HOST
    for origin in ('null', f'https://{OWN}', 'http://127.0.0.1', f'http://{OWN}.evil.example'):
        assert access.check(page, [OWN], [origin]) is Refusal.ORIGIN, origin
        assert access.check(socket, [OWN], [origin]) is Refusal.ORIGIN, origin
    # Browsers send the origin with every websocket.
    assert access.check(socket, [OWN], []) is Refusal.ORIGIN


def test_the_page_with_its_token(server):
    status, headers, body = get(server, f'/{server.token}/')
    assert status == 200
    assert body
    assert headers['X-Content-Type-Options'] == 'nosniff'
    policy = headers['Content-Security-Policy']
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
    assert "frame-ancestors 'none'" in policy
    assert 'unsafe' not in policy
    assert headers['Referrer-Policy'] == 'no-referrer'
    assert 'Set-Cookie' not in headers
    for name in ('../server.py', '%2e%2e/server.py', '/etc/passwd', 'no.js', '..'):
        assert get(server, f'/{server.token}/{name}')[0] == 404, name


def test_requests_without_access_are_refused(server):
    status, headers, body = get(server, '/')
    assert (status, b'token' in body) == (403, True)
    assert 'Content-Security-Policy' in headers
    path = f'/{server.token}/'
    assert get(server, path, Host='evil.example')[0] == 403
    assert get(server, path, Origin='http://evil.example')[0] == 403
    for opened in (
        {'path': '/wrong/socket'},
        {'host': 'evil.example', 'origin': 'http://evil.example'},
        {'origin': None},
        {'origin': 'http://evil.example'},
    ):
        with pytest.raises(InvalidStatus, match='403'):
            page(server, **opened)
    assert not session_of(server).watched


def test_the_ticket_opens_the_page_once(own):
    path = own.server.opening_url.removeprefix(f'http://127.0.0.1:{own.port}')
    assert own.token not in path
    status, headers, _ = get(own, path)
    assert (status, headers['Location']) == (303, f'/{own.token}/')
    assert get(own, path)[0] == get(own, '/open/')[0] == 403


def test_it_listens_on_this_machine_only(own):
    assert own.server._socket.getsockname()[0] == '127.0.0.1'
    assert own.server.shared_url == ''
    with pytest.raises(OSError, match='in use'):
        LiveServer(Session(), own.port)
    with pytest.raises(OSError, match='refused'):
        socket.create_connection((GUESTS, own.port), timeout=5)


# --- Guests


def test_guests_have_a_token_and_a_host_of_their_own(guests):
    inside = guests.server.access
    assert guests.server.shared_url == f'http://{GUESTS}:{guests.port}/{guests.token}/'
    assert guests.token != inside.token
    assert get(guests, f'/{guests.token}/')[0] == 200
    # What is true of one address is not of the other.
    assert get(guests, f'/{inside.token}/')[0] == 403
    assert get(guests, f'/open/{inside.ticket}')[0] == get(guests, '/open/')[0] == 403
    assert get(guests, f'/{guests.token}/', Host=f'127.0.0.1:{guests.port}')[0] == 403
    assert get(guests, f'/{guests.token}/', Host='localhost')[0] == 403
    for opened in ({'path': f'/{inside.token}/socket'}, {'origin': f'http://127.0.0.1:{guests.port}'}):
        with pytest.raises(InvalidStatus, match='403'):
            page(guests, **opened)
    guests.host = '127.0.0.1'
    assert get(guests, f'/{guests.token}/')[0] == 403
    status, headers, code = get(guests, f'/{inside.token}/share.svg')
    assert (status, headers['Content-Type']) == (200, 'image/svg+xml')
    assert code.startswith(b'<?xml')


def test_guests_look_and_whoever_steers_is_disconnected(guests):
    session = session_of(guests)
    session.store(Snapshot(world={'kind': 'robots'}))
    with page(guests) as guest, page(guests) as other:
        may = json.loads(guest.recv(timeout=20))['may']
        assert may == {'steer': False, 'shared': '', 'guests_steer': False}
        assert 'may' in json.loads(other.recv(timeout=20))
        guest.send(DRIVE)
        assert closed(guest) == 1008
        assert session.take_commands() == []
        session.store(Snapshot(world={'kind': 'lockstep'}))
        frame = json.loads(other.recv(timeout=20))
        assert (frame['world']['kind'], 'may' in frame) == ('lockstep', False)
    guests.host, guests.token = '127.0.0.1', guests.server.access.token
    with page(guests) as inside:
        may = json.loads(inside.recv(timeout=20))['may']
        assert may == {
            'steer': True,
            'shared': guests.server.shared_url,
            'guests_steer': False,
        }
        inside.send(DRIVE)
        until(session.take_commands, 'the page of this machine is served')


def test_guests_cannot_keep_the_page_of_this_machine_from_its_owner(guests, monkeypatch):
    monkeypatch.setattr(live_server, 'MAX_STRANGERS', 4)
    with contextlib.ExitStack() as stack:
        for _ in range(60):
            stack.enter_context(socket.create_connection((GUESTS, guests.port), timeout=20))
        guests.host, guests.token = '127.0.0.1', guests.server.access.token
        with page(guests) as inside:
            inside.send(DRIVE)
            until(session_of(guests).take_commands, 'it is served')


def test_an_address_that_is_none_of_this_machine_leaves_nothing_open():
    with socket.create_server(('127.0.0.1', 0)) as free:
        port = free.getsockname()[1]
    for _ in range(2):
        with pytest.raises(OSError, match='assign'):
            LiveServer(Session(), port, Share('192.0.2.200'))


# --- What it withstands


def test_commands_arrive_with_their_page(server):
    with page(server) as first, page(server) as second:
        first.send(DRIVE)
        second.send(DRIVE)
        taken = []
        until(lambda: taken.extend(session_of(server).take_commands()) or len(taken) == 2, 'commands')
    assert [command for _, command in taken] == [DriveByHand('/', 0.2, 0.0)] * 2
    numbers = [number for number, _ in taken]
    assert len(set(numbers)) == 2
    until(lambda: not any(map(session_of(server).is_open, numbers)), 'both pages are gone')


def closed(socket):
    """Wait until the server has closed a websocket; return the code."""
    with contextlib.suppress(ConnectionClosed):
        for _ in socket:
            pass
    return socket.close_code


def test_a_flood_disconnects_the_page(server):
    with page(server) as flooding, page(server) as other:
        with contextlib.suppress(ConnectionClosed):
            for _ in range(3000):
                flooding.send(DRIVE)
        assert closed(flooding) == 1008
        session_of(server).take_commands()
        other.send(DRIVE)
        until(session_of(server).take_commands, 'the other page is served')


def test_malformed_commands_are_refused_and_then_disconnect(server):
    with page(server) as bad:
        bad.send('{"do": "drive", "robot": "/", "v": NaN, "omega": 0}')
        while 'notices' not in (frame := json.loads(bad.recv(timeout=20))):
            pass
        assert frame['notices'][0]['text'].startswith('command refused: a command must be JSON')
        # Not one more: the server would close while this page sends. Not each is a notice for all.
        for _ in range(MAX_INVALID - 1):
            bad.send(b'\x00\xff')
        assert closed(bad) == 1008
    assert session_of(server).take_commands() == []
    assert len(session_of(server).notices_after(0)) == live_server.NOTICES


def test_large_messages_and_too_many_pages_are_disconnected(server):
    for message in ('x' * 5000, b'\x00' * 100_000):
        with page(server) as bad:
            bad.send(message)
            assert closed(bad) == 1009
    until(lambda: not session_of(server).watched, 'the pages are gone')
    with contextlib.ExitStack() as stack:
        for _ in range(server.most):
            stack.enter_context(page(server))
        assert closed(stack.enter_context(page(server))) == 1013


def test_what_is_no_http_is_disconnected(server):
    for garbage in (
        b'\x16\x03\x01' * 50 + b'\r\n\r\n',
        b'GET / HTTP/1.1\r\n' + b'a: b\r\n' * 500,
        b'POST / HTTP/1.1\r\n\r\n',
    ):
        with socket.create_connection((server.host, server.port), timeout=20) as raw:
            raw.sendall(garbage)
            received = b''
            with contextlib.suppress(ConnectionResetError):
                while data := raw.recv(4096):
                    received += data
            assert b'200' not in received.split(b'\r\n')[0]
    assert get(server, f'/{server.token}/')[0] == 200


def test_connections_that_ask_for_nothing_do_not_use_up_descriptors(monkeypatch, server):
    # Others are disconnected because they are too many, not because they are silent.
    monkeypatch.setattr(live_server, 'MAX_STRANGERS', 16)
    monkeypatch.setattr(live_server, 'PATIENCE', 1e3)
    with page(server) as first, contextlib.ExitStack() as stack:
        idle = [
            stack.enter_context(socket.create_connection((server.host, server.port), timeout=20))
            for _ in range(16 * server.times + 4)
        ]
        assert get(server, f'/{server.token}/')[0] == 200
        # Those that the server has disconnected can be read.
        until(lambda: len(select.select(idle, [], [], 0)[0]) >= 4, 'others are disconnected')
        first.send(DRIVE)
        until(session_of(server).take_commands, 'the page is served')


def test_a_page_that_does_not_read_delays_nobody(server):
    """Its states are dropped, what waits is bounded, and storing a state takes no time."""
    session = session_of(server)
    big = [{'name': '/', 'filling': 'x' * 100_000}]
    with page(server) as reading, page(server):
        until(lambda: len(session._pages) == 2, 'both pages')
        before = time.thread_time()
        for number in range(200):
            session.store(Snapshot(robots=big, world={'number': number}))
        assert time.thread_time() - before < 0.1
        numbers = [0]
        while numbers[-1] != 199:
            numbers.append(json.loads(reading.recv(timeout=20))['world'].get('number', 0))
        assert numbers == sorted(numbers)


def test_it_ends_while_pages_are_open():
    server = Doors(Share(GUESTS, control=True))
    with page(server) as open_page:
        server.close()
        assert closed(open_page) == 1001
    with pytest.raises(OSError, match='refused'):
        socket.create_connection(('127.0.0.1', server.port), timeout=5)
