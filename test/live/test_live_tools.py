"""watch_run and drive_to --live as commands."""

from __future__ import annotations

import json
import re
import signal
import socket
import sys
from types import SimpleNamespace

import pytest
from chromium import until
from websockets.sync.client import connect

from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import drive_to, watch_run

QUICK = ('--ros-args', '-p', 'go_to_goal:kp:=8.0', '-p', 'go_to_goal:kv:=4.0')


def opened(child):
    """Open the page that a command serves, without a browser."""
    child.until_says(r'page: http://\S+/\n(.|\n)*\n')
    url = re.search(r'page: http(://(\S+?)/\S+/)', child.stdout)
    return connect(f'ws{url[1]}socket', origin=f'http://{url[2]}', proxy=None, open_timeout=20)


def robots(page):
    """Return the robots of the next state, by name."""
    return {one['name']: one for one in json.loads(page.recv(timeout=20))['robots']}


@pytest.mark.process
def test_watch_run_beside_nodes_and_the_robot_stops_with_the_page(world):
    """In processes of their own, by DDS. It ends by Ctrl-C, and so does driving by hand."""
    robot = world.start('virtual_robot', '--ros-args', '-r', '__ns:=/r')
    watch = world.start('watch_run', '--no-browser')
    drive = json.dumps({'do': 'drive', 'robot': '/r', 'v': 0.3, 'omega': 0.0})
    with opened(watch) as page:
        until(lambda: '/r' in robots(page), 'the robot is found')

        def moving():
            page.send(drive)
            return robots(page)['/r']['now']['v'] == 0.3

        until(moving, 'it drives')
        # The network fails: no closing handshake.
        page.socket.shutdown(socket.SHUT_RDWR)
    with opened(watch) as page:
        until(lambda: robots(page)['/r']['now']['v'] == 0.0, 'it stops')
        watch.signal(signal.SIGINT)
        assert watch.exit() == 0
    assert watch.stderr == ''
    robot.signal(signal.SIGINT)
    assert robot.exit() == 0


@pytest.mark.process
def test_drive_to_live_waits_for_the_page_records_and_ends_by_a_signal(world, tmp_path):
    bag = str(tmp_path / 'bag')
    drive = world.start(
        'drive_to', '0.2', '0.1', '--live', '--lockstep', '--no-browser', '-o', bag, *QUICK
    )
    with opened(drive) as page:
        page.send(json.dumps({'do': 'speed', 'speed': 50}))
        until(lambda: robots(page).get('/', {}).get('goal', {}).get('state') == 'succeeded', 'arrives')
    drive.signal(signal.SIGTERM)
    assert drive.exit() == 0
    assert 'it goes on after the goals, until Ctrl-C' in drive.stdout
    (end,) = (line for line in drive.stdout.splitlines() if line.startswith('goal '))
    assert re.fullmatch(
        r'goal \(0\.2, 0\.1\) arrived: the robot is at x 0\..* 0\.0\d\d m from the goal', end
    )
    assert drive.last_line == f'recorded: {tmp_path / "bag"}'
    assert drive.stderr == ''
    watch = world.start('watch_run', str(tmp_path / 'bag'), '--no-browser', '--rate', '5')
    with opened(watch) as page:
        frame = json.loads(page.recv(timeout=20))
        while 'speed' not in frame['world']:
            # The page was opened before the first frame of the bag.
            frame = json.loads(page.recv(timeout=20))
        assert frame['world']['speed'] == 5.0
        assert len(frame['paths']['/']['points']) > 10
    # There is no robot to steer.
    assert 'steer' not in watch.stdout
    assert 'plays the bag' in watch.stdout
    watch.signal(signal.SIGINT)
    assert watch.exit() == 0


@pytest.mark.process
def test_drive_to_live_in_real_time(world):
    drive = world.start('drive_to', '0.1', '0', '--live', '--no-record', '--no-browser', *QUICK)
    with opened(drive) as page:
        until(lambda: robots(page).get('/', {}).get('goal', {}).get('state') == 'succeeded', 'arrives')
    drive.signal(signal.SIGINT)
    assert (drive.exit(), drive.stderr) == (0, '')


# --- Arguments


def test_a_port_in_use_a_bag_that_is_none_and_a_missing_library(capsys, tmp_path, monkeypatch):
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = str(taken.getsockname()[1])
        assert watch_run.main(['--port', port, '--no-browser'], Signals()) == 1
        assert f'--port {port} is in use' in capsys.readouterr().err
        monkeypatch.chdir(tmp_path)
        arguments = ['--live', '--no-browser', '--port', port]
        assert drive_to.main(arguments, Signals()) == 1
        assert f'drive_to: error: --port {port} is in use' in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []
    assert watch_run.main([str(tmp_path / 'none')], Signals()) == 2
    assert 'watch_run: error: ' in capsys.readouterr().err
    for name in [name for name in sys.modules if name.startswith('diffdrive_jacobian.live')]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, 'websockets', None)
    for name in [name for name in sys.modules if name.startswith('websockets.')]:
        monkeypatch.delitem(sys.modules, name)
    assert watch_run.main([], Signals()) == 1
    assert "pip install 'diffdrive_jacobian[live]'" in capsys.readouterr().err


def test_the_browser_is_started_without_the_secret_and_only_on_a_display(capsys, monkeypatch):
    options, opened_urls = SimpleNamespace(no_browser=False), []
    server = SimpleNamespace(
        url='http://127.0.0.1:1/secret/', opening_url='http://127.0.0.1:1/open/once'
    )
    monkeypatch.setattr(watch_run.webbrowser, 'open', opened_urls.append)
    for name in watch_run.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    watch_run.announcing(options)(server)
    assert opened_urls == []
    assert 'page: http://127.0.0.1:1/secret/' in capsys.readouterr().out
    monkeypatch.setenv('DISPLAY', ':0')
    watch_run.announcing(options)(server)
    until(lambda: opened_urls == ['http://127.0.0.1:1/open/once'], 'the browser is started')
