"""The tool drive_to in simulated time."""

from __future__ import annotations

import errno
import math
import os
import re
import signal
import threading
from functools import partial

import numpy as np
import pytest
from support.processes import open_world

from diffdrive_jacobian.bags import journal, read_run
from diffdrive_jacobian.bags.timeline import timeline
from diffdrive_jacobian.lockstep import runner as testing_runner
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.parameters.nodes import CONTROLLERS
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.testing import Lockstep
from diffdrive_jacobian.tools import _progress, drive_to

QUICK = ('--ros-args', '-p', 'kp:=12.0', '-p', 'kv:=3.0')
CRAWL = (
    '50',
    '0',
    '--timeout',
    '1e6',
    '--no-record',
    '--ros-args',
    '-p',
    'linear.x.max_velocity:=0.001',
)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Record to a temporary directory."""
    monkeypatch.chdir(tmp_path)


def last_line(capsys):
    """Return the line about the drive; lines about the recording and the picture follow it."""
    return next(line for line in capsys.readouterr().out.splitlines() if 'the robot stopped' in line)


@pytest.mark.parametrize('goals', [(1, 1), (-3, 0), (0.5, 0, 0.5, 0.5, 0, 0), (0, 0)])
def test_arrives_with_the_same_output_each_time(capsys, goals):
    said = set()
    for record in (['--no-plot'], ['--no-record']):
        assert drive_to.main([*map(str, goals), '--lockstep', *record, *QUICK], Signals()) == 0
        said.add(last_line(capsys))
    (line,) = said
    numbers = re.fullmatch(
        r'arrived: the robot stopped at x (\S+) m, y (\S+) m, heading \S+ rad, '
        r'(\S+) m from the goal, after (\S+) s of simulated time',
        line,
    )
    x, y, distance, _ = map(float, numbers.groups())
    assert distance <= 0.02
    assert math.dist((x, y), goals[-2:]) <= 0.021


def test_the_true_distance_of_a_robot_that_slips_is_that_of_its_ground_truth(tmp_path, capsys):
    slip = ('-p', 'simulate_slip:=true', '-p', 'wheel_travel_variance:=0.002')
    assert (
        drive_to.main(['1', '1', '--lockstep', '-o', 'bag', '--no-plot', *QUICK, *slip], Signals()) == 0
    )
    line = last_line(capsys)
    found = re.search(r' (\S+) m from the goal by odometry, (\S+) m by ground truth, after', line)
    distance, truth = map(float, found.groups())
    end = read_run(tmp_path / 'bag').ground_truth.values[-1, :2]
    assert distance <= 0.02 < truth
    assert truth == pytest.approx(math.dist(end, (1.0, 1.0)), abs=1e-3)


@pytest.mark.parametrize('controller', CONTROLLERS)
def test_the_error_of_the_heading_ends_where_the_robot_is(tmp_path, controller):
    heading = 2.5
    arguments = ('0.5', '0', '0.5', '0.5', '--lockstep', '-o', 'bag', '--no-plot')
    options = ('--heading', str(heading), '--controller', controller)
    assert drive_to.main([*arguments, *options, *QUICK], Signals()) == 0
    run = read_run(tmp_path / 'bag')
    one = timeline(run)
    last = one.goal == 1
    theta = run.odometry.values[:, 2]
    expected = np.angle(np.exp(1j * (heading - theta)))
    np.testing.assert_allclose(one.goal_heading_error[last], expected[last], atol=1e-9)
    assert np.isnan(one.goal_heading_error[~last]).all()
    assert abs(one.goal_heading_error[-1]) <= 0.02
    assert np.isnan(one.bearing_error[-1])


def test_without_a_heading_there_is_no_error_of_it(tmp_path):
    assert drive_to.main(['1', '1', '--lockstep', '-o', 'bag', '--no-plot', *QUICK], Signals()) == 0
    assert np.isnan(timeline(read_run(tmp_path / 'bag')).goal_heading_error).all()


def test_duration_is_that_of_the_control_law(capsys):
    """Straight ahead the distance decays as exp(-kv t), in steps of the odometry's period."""
    assert (
        drive_to.main(['1', '0', '--lockstep', '--no-record', '--ros-args', '-p', 'kv:=2.0'], Signals())
        == 0
    )
    seconds = float(re.search(r'after (\S+) s of simulated time', last_line(capsys)).group(1))
    period, kv = 0.02, 2.0
    steps = math.ceil(math.log(0.02) / math.log(1.0 - kv * period))
    assert seconds == pytest.approx(steps * period, abs=0.1)


@pytest.mark.parametrize('controller', CONTROLLERS)
def test_every_controller_arrives_and_takes_the_heading_that_is_asked_for(tmp_path, capsys, controller):
    arguments = ['0.5', '0.5', '0', '1', '--heading', '-2.5', '--controller', controller, '--no-plot']
    assert drive_to.main([*arguments, '--lockstep', '-o', 'bag', *QUICK], Signals()) == 0
    x, y, theta = map(
        float, re.search(r'x (\S+) m, y (\S+) m, heading (\S+) rad', last_line(capsys)).groups()
    )
    offset = 0.1 if controller == 'offset_point' else 0.0
    assert math.hypot(x, y - 1.0) <= offset + 0.021
    assert theta == pytest.approx(-2.5, abs=0.021)
    run = read_run(tmp_path / 'bag')
    seen = timeline(run)
    first, last = (seen.distance[seen.goal == index] for index in (0, 1))
    # Of the point that is driven: it comes to each goal, and nothing is taken for the next one too soon.
    assert first.min() <= 0.021
    assert last.min() <= 0.021
    assert first[0] == pytest.approx(math.hypot(0.5 - offset, 0.5), abs=1e-6)


def test_without_a_heading_any_will_do(capsys):
    gains = ['--ros-args', '-p', 'kp:=12.0', '-p', 'kv:=2.0']
    assert drive_to.main(['0', '1', '--lockstep', '--no-record', *gains], Signals()) == 0
    theta = float(re.search(r'heading (\S+) rad', last_line(capsys)).group(1))
    assert theta == pytest.approx(math.pi / 2.0, abs=0.2)


def test_nothing_is_driven_once_the_drive_is_over(tmp_path, capsys):
    """The timeout is over before the first odometry, so before a goal was sent."""
    assert drive_to.main(['1', '1', '--timeout', '1e-9', '--no-plot', '-o', 'bag'], Signals()) == 1
    assert 'the robot stopped at x 0.000 m, y 0.000 m' in last_line(capsys)
    run = read_run(tmp_path / 'bag')
    assert len(run.goals) == 0
    assert not run.cmd_vel_out.values.any()


def test_timeout_is_of_simulated_time(capsys):
    assert drive_to.main(['50', '0', '--lockstep', '--no-record', '--timeout', '3'], Signals()) == 1
    line = last_line(capsys)
    assert line.startswith('not arrived (--timeout 3 s was too short): ')
    assert line.endswith('after 3.0 s of simulated time')


FULL = 20_000
"""Size at which the disk of a test is full (bytes): less than a drive of a second."""


def test_a_full_disk_is_reported(tmp_path, capsys, monkeypatch):
    """A drive that arrives, but of which only a part is recorded, is not done."""
    write, written = os.write, []

    def limited(descriptor, data):
        if threading.current_thread().name == 'journal':
            if sum(written) + len(data) > FULL:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            written.append(len(data))
        return write(descriptor, data)

    monkeypatch.setattr(journal.os, 'write', limited)
    assert drive_to.main(['1', '1', '--lockstep', '--no-plot', '-o', 'bag', *QUICK], Signals()) == 1
    said = capsys.readouterr()
    assert 'drive_to: error: the recording was aborted: No space left on device' in said.err
    assert said.out.splitlines()[-1] == 'recorded in part: bag'
    assert (tmp_path / 'bag.journal.mcap').exists()


def test_a_stuck_callback_fails_and_the_recording_is_kept(tmp_path, capsys, monkeypatch):
    """That run is the one to look at."""
    on_odometry, never = GoToGoal._on_odometry, threading.Event()

    def stuck(self, *args):
        on_odometry(self, *args)
        while self.get_clock().now().nanoseconds > 2_000_000_000:
            never.wait(0.01)

    monkeypatch.setattr(GoToGoal, '_on_odometry', stuck)
    monkeypatch.setattr(testing_runner, 'Lockstep', partial(Lockstep, patience=0.5))
    assert drive_to.main(['1', '1', '--lockstep', '--no-plot', '-o', 'bag'], Signals()) == 1
    said = capsys.readouterr()
    assert said.err.startswith('drive_to: error: ')
    assert '/go_to_goal' in said.err
    assert said.out.splitlines()[-1] == 'recorded: bag'
    assert len(read_run(tmp_path / 'bag').odometry) >= 50


def test_a_bug_keeps_the_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(_progress.GoalBar, 'show', lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        drive_to.main(['1', '1', '--lockstep', '--no-plot', '-o', 'bag'], Signals())
    assert (tmp_path / 'bag').is_dir()


@pytest.mark.process
def test_ends_on_a_signal(tmp_path):
    signals = (signal.SIGINT, signal.SIGTERM)
    with open_world(tmp_path) as world:
        children = [world.start('drive_to', '--lockstep', *CRAWL) for _ in signals]
        for child, number in zip(children, signals, strict=True):
            child.until_says('m to go')
            child.signal(number)
        for child in children:
            assert child.exit() == 130
            assert child.last_line.startswith('interrupted: the robot stopped at x ')
