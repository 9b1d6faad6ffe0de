"""The fixtures of pytest as a user of the package has them: in a directory and process of their own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from diffdrive_jacobian.reading import read_run
from diffdrive_jacobian.reading.verification import verify

SETTING = """
    import pytest
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from diffdrive_jacobian.testing import LockstepError
"""


@pytest.fixture
def run(pytester):
    """Run tests that have nothing but the fixtures; gives the result."""
    pytester.makeconftest("pytest_plugins = ['diffdrive_jacobian.testing.fixtures']")

    def run(tests, *options):
        pytester.makepyfile(SETTING + tests)
        return pytester.runpytest_subprocess('-W', 'error::pytest.PytestUnknownMarkWarning', *options)

    return run


def test_robots_stand_where_they_are_put_with_their_parameters(run):
    run("""
    def test_two_robots(lockstep, robot_at):
        robot_at(1.0, -2.0, 0.5, namespace='one', linear__x__max_velocity=0.2)
        robot_at(namespace='two')
        one, two = (lockstep.listen(Odometry, f'/{name}/odom') for name in ('one', 'two'))
        twist = Twist()
        twist.linear.x = 1.0
        lockstep.publish('/one/cmd_vel', twist)
        lockstep.run_for(0.5)
        assert one[-2].twist.twist.linear.x == 0.2
        x, y = one[-1].pose.pose.position.x, one[-1].pose.pose.position.y
        assert (x - 1.0) ** 2 + (y + 2.0) ** 2 == pytest.approx(0.1 ** 2)
        assert two[-1].pose.pose.position.x == 0.0
    """).assert_outcomes(passed=1)


@pytest.mark.parametrize('capture', ['fd', 'sys', 'no'])
def test_runs_whatever_pytest_captures(run, capture):
    run(
        """
    def test_drives(lockstep, robot_at, capsys):
        robot_at()
        lockstep.run_for(0.1)
    """,
        f'--capture={capture}',
    ).assert_outcomes(passed=1)


def test_each_test_has_a_world_of_its_own(run):
    result = run("""
    @pytest.mark.parametrize('turn', range(3))
    def test_begins_anew(lockstep, robot_at, turn):
        assert lockstep.elapsed == 0.0
        robot_at()
        lockstep.run_for(1.0)

    @pytest.mark.lockstep(start=7.0, patience=1.0, args=['--ros-args', '-r', '__ns:=/a'])
    def test_is_made_as_marked(lockstep, robot_at):
        assert lockstep.now == 7_000_000_000
        assert robot_at().get_namespace() == '/a'

    def test_marks_do_not_last(lockstep):
        assert lockstep.now == 1_000_000_000

    @pytest.mark.lockstep(3)
    def test_has_a_mark_without_a_name(lockstep):
        pass
    """)
    result.assert_outcomes(passed=5, errors=1)
    result.stdout.fnmatch_lines(
        ['*TypeError: the marker lockstep takes args=, start= and patience= only, got (3,)']
    )


def test_a_failure_tells_the_last_messages_once(run):
    result = run("""
    def test_fails(lockstep, robot_at):
        robot_at()
        lockstep.publish('cmd_vel', Twist())
        assert False

    def test_waits_in_vain(lockstep, robot_at):
        robot_at()
        lockstep.run_until(lambda: False, timeout=1.0, what='the end of the world')

    def test_passes(lockstep, robot_at):
        robot_at()
    """)
    result.assert_outcomes(failed=2, passed=1)
    text = result.stdout.str()
    assert text.count('  /cmd_vel: 1 from /lockstep, last at 1 s: Twist()') == 1
    assert 'not within 1 s of simulated time: the end of the world' in text
    assert text.count('- lockstep -') == 1


def test_a_callback_that_raises_fails_the_test_with_its_traceback(run):
    result = run("""
    def test_raises(lockstep):
        def on_tick():
            raise KeyError('no such wheel')
        lockstep.node.create_timer(0.1, on_tick)
        lockstep.run_for(1.0)
    """)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*raise KeyError('no such wheel')", "E * KeyError: 'no such wheel'"])


def test_parallel_worlds_do_not_hear_each_other(run, pytester):
    """Two processes at once, on one domain, with one topic."""
    tests = """
    import os, pathlib, time

    def test_hears_only_itself(lockstep, robot_at):
        robot_at()
        odom = lockstep.listen(Odometry, 'odom')
        twist = Twist()
        twist.linear.x = float(os.environ['SPEED'])
        me, other = (pathlib.Path(os.environ[name]) for name in ('ME', 'OTHER'))
        me.touch()
        met, begun = 0, time.monotonic()
        while met < 50 and time.monotonic() - begun < 30.0:
            lockstep.publish('cmd_vel', twist)
            lockstep.run_for(0.1)
            met += other.exists()
        assert met == 50
        assert odom[-1].pose.pose.position.x == pytest.approx(lockstep.elapsed * twist.linear.x)
        assert len(odom) == round(50 * lockstep.elapsed)
    """
    run(tests, '--collect-only')
    command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider']
    processes = []
    for me, other, speed in (('a', 'b', '1.0'), ('b', 'a', '-1.0')):
        environment = {**os.environ, 'SPEED': speed, 'ME': me, 'OTHER': other}
        environment.pop('ROS_AUTOMATIC_DISCOVERY_RANGE')
        processes.append(subprocess.Popen(command, cwd=pytester.path, env=environment))
    assert [process.wait(timeout=60) for process in processes] == [0, 0]


def test_run_of_a_failed_test_is_kept_and_of_others_is_not(run, pytester):
    result = run(
        """
    import pathlib

    def test_fails(lockstep, robot_at, recorded_run):
        robot_at()
        twist = Twist()
        twist.linear.x = 0.5
        lockstep.publish('cmd_vel', twist)
        lockstep.run_for(1.0)
        assert False

    def test_passes(lockstep, robot_at, recorded_run):
        robot_at()
        lockstep.run_for(1.0)
    """,
        '--basetemp=kept',
    )
    result.assert_outcomes(failed=1, passed=1)
    (bag,) = pytester.path.glob('kept/*/run')
    run_of_it = read_run(bag)
    assert len(run_of_it.odometry) >= 50
    assert verify(run_of_it).holds(1e-9, 1e-9)
    text = result.stdout.str()
    assert f'\n{bag}\n{bag}.png\n' in text
    assert bag.with_suffix('.png').read_bytes().startswith(b'\x89PNG')
    assert not list(pytester.path.glob('kept/*/run.journal'))


KEPT_TWICE = """
    def test_kept_by_hand(lockstep, robot_at, recorded_run):
        robot_at()
        lockstep.run_for(1.0)
        first = recorded_run.keep()
        lockstep.run_for(1.0)
        assert recorded_run.keep() == first
        assert False, first

    def test_of_the_same_session(lockstep):
        pass
"""


def test_a_run_that_was_kept_by_hand_is_kept_once(run, pytester):
    result = run(KEPT_TWICE, '--basetemp=kept')
    result.assert_outcomes(failed=1, passed=1)
    bag = pytester.path / 'kept' / 'recorded0' / 'run'
    assert f'\n{bag}\n{bag}.png\n' in result.stdout.str()
    assert len(read_run(bag).odometry) == 51


FULL_DISK = """
    import errno, os
    from diffdrive_jacobian.bags.journal import JournalWriter
    from diffdrive_jacobian.recording.recording import RecordingError

    @pytest.fixture
    def full_disk(lockstep, recorded_run, monkeypatch):
        def write(*_):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        monkeypatch.setattr(JournalWriter, 'flush', write)

    def test_fails(lockstep, robot_at, recorded_run, full_disk):
        robot_at()
        lockstep.run_for(1.0)
        assert False

    def test_keeps(lockstep, robot_at, recorded_run, full_disk):
        robot_at()
        lockstep.run_for(1.0)
        with pytest.raises(RecordingError, match='No space left on device'):
            recorded_run.keep()
        with pytest.raises(RecordingError, match='No space left on device'):
            recorded_run.keep()
"""


def test_a_recording_on_a_full_disk_is_reported_and_the_session_goes_on(run):
    result = run(FULL_DISK)
    result.assert_outcomes(failed=1, passed=1)
    text = result.stdout.str()
    assert 'the recording was aborted: No space left on device' in text
    assert 'INTERNALERROR' not in text


def test_no_hook_raises(run):
    result = run("""
    import pytest

    def broken():
        raise KeyError('of a bug')

    def timed_out():
        pytest.fail('Timeout')

    def test_fails(lockstep, recorded_run, monkeypatch):
        monkeypatch.setattr(lockstep, 'report', broken)
        monkeypatch.setattr(recorded_run, 'keep', broken)
        assert False

    def test_fails_while_a_plugin_stops_it(lockstep, recorded_run, monkeypatch):
        monkeypatch.setattr(recorded_run, 'keep', timed_out)
        assert False

    def test_of_the_same_session(lockstep):
        pass
    """)
    result.assert_outcomes(failed=2, passed=1)
    text = result.stdout.str()
    assert text.count("not available: KeyError('of a bug')") == 2
    assert 'INTERNALERROR' not in text
