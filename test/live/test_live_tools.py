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

"""watch_run and drive_to --live as commands."""

from __future__ import annotations

import http.client
import json
import re
import signal
import socket
import sys
from types import SimpleNamespace
from urllib.parse import urlsplit

import pytest
from chromium import until
from support import commands
from websockets.sync.client import connect

from diffdrive_jacobian.drives import driving
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import watch_run

QUICK = ('--ros-args', '-p', 'go_to_goal:kp:=8.0', '-p', 'go_to_goal:kv:=4.0')


WITHOUT_ROS = 'drive_to: ROS 2 is not available: the same robot drives by the same laws without nodes\n'


def opened(url):
    """Open a page, without a browser."""
    host = urlsplit(url).netloc
    return connect(
        f'ws://{host}{urlsplit(url).path}socket', origin=f'http://{host}', proxy=None, open_timeout=20
    )


def robots(page):
    """Return the robots of the next state, by name."""
    return {one['name']: one for one in json.loads(page.recv(timeout=20))['robots']}


def has_arrived(page):
    return robots(page).get('/', {}).get('goal', {}).get('state') == 'succeeded'


@pytest.fixture
def run_with_page(monkeypatch):
    """Run a command; `visit` sees its page instead of a browser, and then a signal comes."""

    def run_with(visit, *command):
        signals, visits = Signals(), []

        def browser(url):
            """Use the ticket, which stands for the secret where others can read it."""
            host, path = urlsplit(url)[1:3]
            try:
                server = http.client.HTTPConnection(host, timeout=20)
                server.request('GET', path)
                token = server.getresponse().headers['Location']
                assert token not in url
                with opened(f'http://{host}{token}') as page:
                    visits.append(visit(page))
            finally:
                signals.count = 1

        monkeypatch.setattr(watch_run.webbrowser, 'open', browser)
        monkeypatch.setenv('DISPLAY', ':0')
        ended = commands.run(*command, signals=signals)
        assert len(visits) == 1, ended
        assert (ended.code, ended.err) == (0, '' if driving.has_ros() else WITHOUT_ROS)
        return ended.out

    return run_with


@pytest.mark.process
def test_watch_run_beside_nodes_and_the_robot_stops_with_the_page(world):
    """In processes of their own, by DDS. It ends by Ctrl-C, and so does driving by hand."""
    world.start('virtual_robot', '--ros-args', '-r', '__ns:=/r')
    watch = world.start('watch_run', '--no-browser')
    watch.until_says(r'page: http://\S+/\n')
    url = re.search(r'page: (\S+)', watch.stdout)[1]
    drive = json.dumps({'do': 'drive', 'robot': '/r', 'v': 0.3, 'omega': 0.0})
    with opened(url) as page:
        until(lambda: '/r' in robots(page), 'the robot is found')

        def moving():
            page.send(drive)
            return robots(page)['/r']['now']['v'] == 0.3

        until(moving, 'it drives')
        # The network fails: no closing handshake.
        page.socket.shutdown(socket.SHUT_RDWR)
    with opened(url) as page:
        until(lambda: robots(page)['/r']['now']['v'] == 0.0, 'it stops')
        watch.signal(signal.SIGINT)
        assert watch.exit() == 0
    assert watch.stderr == ''


@pytest.mark.parametrize(
    ('ros', 'where', 'said'),
    [
        (True, (0.2, 0.1), r'goal \(0\.2, 0\.1\) arrived: .* x 0\..* 0\.0\d\d m from the goal'),
        (False, (0.2, 0.1), r'goal \(0\.2, 0\.1\) arrived: .* x 0\..* 0\.0\d\d m from the goal'),
        (
            False,
            ('--path', 'circle:0.2'),
            r'path to \(.*\) arrived: .* 0\.0\d\d m from the end of the path',
        ),
    ],
)
def test_drive_to_live_waits_for_the_page_and_records_and_watch_run_plays_it(
    run_with_page, tmp_path, monkeypatch, ros, where, said
):
    bag = tmp_path / 'bag'

    def drive(page):
        page.send(json.dumps({'do': 'speed', 'speed': 50}))
        until(lambda: has_arrived(page), 'arrives')

    with monkeypatch.context() as patched:
        patched.setattr(driving, 'has_ros', lambda: ros)
        out = run_with_page(drive, 'drive_to', *where, '--live', '--lockstep', '-o', bag, *QUICK)
    assert 'it goes on after the goals, until Ctrl-C' in out
    goal, recorded = out.splitlines()[-2:]
    assert re.fullmatch(said, goal)
    assert recorded == f'recorded: {bag}'

    def play(page):
        frame = {'world': {}}
        while 'speed' not in frame['world']:
            # The page was opened before the first frame of the bag.
            frame = json.loads(page.recv(timeout=20))
        assert frame['world']['speed'] == 5.0
        assert len(frame['paths']['/']['points']) > 10

    out = run_with_page(play, 'watch_run', bag, '--rate', 5)
    # There is no robot to steer.
    assert 'steer' not in out
    assert 'plays the bag' in out


def test_drive_to_live_in_real_time(run_with_page):
    def drive(page):
        until(lambda: has_arrived(page), 'arrives')

    run_with_page(drive, 'drive_to', 0.1, 0, '--live', '--no-record', *QUICK)


@pytest.mark.parametrize('ros', [True, False])
@pytest.mark.parametrize('how', [(), ('--lockstep',)])
def test_a_goal_that_an_interrupt_cancels_is_told(run_with_page, monkeypatch, ros, how):
    monkeypatch.setattr(driving, 'has_ros', lambda: ros)

    def drive(page):
        until(lambda: robots(page).get('/', {}).get('goal', {}).get('active'), 'drives')

    out = run_with_page(drive, 'drive_to', 30, 0, '--live', '--no-record', *how)
    assert re.search(r'^goal \(30, 0\) canceled: the robot is at x ', out, re.MULTILINE)


@pytest.mark.parametrize('ros', [True, False])
def test_what_was_not_sent_because_no_page_was_open_is_told(monkeypatch, ros):
    monkeypatch.setattr(driving, 'has_ros', lambda: ros)
    command = ('drive_to', 1, 1, '--live', '--lockstep', '--no-browser', '--no-record')
    ended = commands.run(*command, signals=commands.interrupted())
    assert (ended.code, 'no page was open: nothing was sent' in ended.err) == (1, True)
    assert commands.run('drive_to', *command[3:], signals=commands.interrupted()).code == 0


def test_without_a_display_the_address_is_printed_and_no_browser_started(monkeypatch, capsys):
    server = SimpleNamespace(url='http://127.0.0.1:1/secret/', opening_url='', shared_url='')
    monkeypatch.setattr(watch_run.threading, 'Thread', None)
    for name in watch_run.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    watch_run.announcing(SimpleNamespace(no_browser=False))(server)
    assert f'page: {server.url}' in capsys.readouterr().out


def test_the_address_for_guests_is_printed_with_what_it_allows(capsys):
    server = SimpleNamespace(url='http://127.0.0.1:1/a/', shared_url='http://192.168.1.7:1/b/')
    for control, words in ((False, 'that address can look'), (True, 'that address can STEER')):
        watch_run.announcing(SimpleNamespace(no_browser=True, share_control=control))(server)
        out = capsys.readouterr().out
        assert f'guests: {server.shared_url}' in out
        assert words in out
        assert 'not encrypted' in out


# --- What prevents the page


@pytest.mark.parametrize('address', ['0.0.0.0', '127.0.0.1', '224.0.0.1', '::', 'robot.local', ''])
def test_an_address_that_is_not_one_of_this_machine_is_refused(address):
    assert 'by which others reach this machine' in commands.refused('watch_run', '--share', address)


def test_addresses_of_this_machine_are_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = commands.refused('drive_to', '--live', '--no-browser', '--share', '203.0.113.7', code=1)
    assert '--share 203.0.113.7 is no address of this machine, which has ' in message


def test_a_port_in_use_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = taken.getsockname()[1]
        for command in (('watch_run',), ('drive_to', '--live')):
            message = commands.refused(*command, '--no-browser', '--port', port, code=1)
            assert f'--port {port} is in use: choose another one' in message
    assert list(tmp_path.iterdir()) == []


def test_a_missing_library_is_named(monkeypatch):
    for name in [*sys.modules]:
        if name.startswith(('diffdrive_jacobian.live', 'websockets.')):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'websockets', None)
    assert "pip install 'diffdrive_jacobian[live]'" in commands.refused('watch_run', code=1)
