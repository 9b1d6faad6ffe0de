"""Tools that read bags end with the next message after a signal, however long the bag is."""

from __future__ import annotations

import pytest
from geometry_msgs.msg import TwistStamped
from support.bags import SECOND, write_bag
from support.ros_messages import joint_command, odometry, stamp

from diffdrive_jacobian.bags import read_run, verify
from diffdrive_jacobian.bags.bag_reader import ReadingInterruptedError
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import calibrate_run, plot_run, verify_run

COUNT = 20


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    sent = []
    for index in range(COUNT):
        at = 1.0 + index / 10
        message = odometry(0.0, 0.0, 0.0)
        message.header.stamp = stamp(round(at * SECOND))
        sent += [
            (at, '/odom', message),
            (at, '/joint_states', joint_command(0.0, 0.0, round(at * SECOND))),
        ]
    sent.append((1.05, '/cmd_vel_out', TwistStamped()))
    sent[-1][-1].header.stamp = stamp(round(1.05 * SECOND))
    return write_bag(tmp_path_factory.mktemp('bags') / 'bag', sorted(sent, key=lambda one: one[0]))


class After:
    """Becomes true with a call."""

    def __init__(self, calls):
        self.calls = calls

    def __call__(self):
        self.calls -= 1
        return self.calls < 0


@pytest.mark.parametrize('calls', [0, COUNT])
def test_reading_ends_with_the_next_message(bag, calls):
    after = After(calls)
    with pytest.raises(ReadingInterruptedError):
        read_run(bag, interrupted=after)
    assert after.calls == -1


@pytest.mark.parametrize('calls', [0, COUNT // 2])
def test_a_verification_ends_with_the_next_message(bag, calls):
    after = After(calls)
    run = read_run(bag)
    with pytest.raises(ReadingInterruptedError):
        verify(run, interrupted=after)
    assert after.calls == -1


@pytest.mark.parametrize(
    ('tool', 'arguments'),
    [(verify_run, ()), (plot_run, ('-o', 'a.png')), (calibrate_run, ('--reference', '/odom'))],
)
def test_a_signal_ends_the_tool(bag, tool, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    signals = Signals()
    signals.count = 1
    assert tool.main([str(bag), *arguments], signals) == 130
    out, err = capsys.readouterr()
    assert out == ''
    assert 'interrupted' in err
    assert not list(tmp_path.iterdir())
