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

"""replay_run: replay of a bag, and verification of a run."""

from __future__ import annotations

import shutil
import signal

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Goals
from rclpy.serialization import serialize_message
from rosbags.interfaces import QosDurability, QosReliability, QosTime
from rosgraph_msgs.msg import Clock
from support.bags import REAL, SECOND, count_more
from support.commands import interrupted, refused, run
from support.raw_bags import LATCHED, channel
from support.ros_messages import goal, goals, twist, twists

from diffdrive_jacobian.bags.bag_writer import build_bag
from diffdrive_jacobian.bags.journal import Message
from diffdrive_jacobian.recording.qos import publisher_profile
from diffdrive_jacobian.recording.replaying import Playback, Replayer, ReplayProgress, replay
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import replay_run

pytestmark = pytest.mark.slow
FAST = ('-r', '50')
ACKED = ('--wait-for-all-acked', '20000')
"""A reader may find the publisher later than the publisher finds the reader."""


TYPES = {'/cmd_vel': ('geometry_msgs/msg/Twist',), '/goals': ('nav_msgs/msg/Goals', (LATCHED,))}
COMMANDS = [(index / 50, -index / 50) for index in range(51)]
BEGIN, LENGTH = 10.0, 1.0
"""Of the recording (s)."""


def build(path, *sent):
    """Write a bag of (seconds, topic, message)."""
    channels = {topic: channel(number, topic, *TYPES[topic]) for number, topic in enumerate(TYPES)}
    records = [
        Message(channels[topic].id, round(seconds * SECOND), serialize_message(message))
        for seconds, topic, message in sent
    ]
    build_bag(channels.values(), records, path)
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A bag of a second: a goal, and commands at 50 Hz."""
    commands = [(BEGIN + index / 50, '/cmd_vel', twist(*one)) for index, one in enumerate(COMMANDS)]
    path = tmp_path_factory.mktemp('bags') / 'run'
    return build(path, (BEGIN, '/goals', goals(goal(1.0, 0.5))), *commands)


@pytest.fixture
def impatient(monkeypatch):
    """Do not wait for subscriptions that nobody makes."""
    monkeypatch.setattr(replay_run, 'MATCH_PATIENCE', 0.1)


@pytest.fixture
def play(world, capfd):
    """Run the tool in this process; return exit code, stdout and stderr."""

    def play(bag, *arguments, signals=None):
        capfd.readouterr()
        code = replay_run.main([str(bag), *arguments], signals or Signals())
        return code, *capfd.readouterr()

    return play


# --- What is played


def test_commands_come_as_recorded_and_only_they(world, bag, play):
    received, told = world.harness.listen(Twist, 'cmd_vel'), world.harness.listen(Goals, 'goals')
    # Acknowledged before the usual heartbeat of three seconds.
    code, out, _ = play(bag, '-r', '20', '-w', '1', '--wait-for-all-acked', '2900', '--timeout', '60')
    assert code == 0
    assert out.splitlines()[-1] == f'{len(COMMANDS)} messages played'
    world.harness.until(lambda: len(received) == len(COMMANDS), 'all have come')
    assert twists(received) == COMMANDS
    assert told == []


def test_offset_and_another_name(world, bag, play):
    """Playing under the recorded name instead would move the real robot."""
    real, received = (world.harness.listen(Twist, name) for name in ('cmd_vel', 'sim/cmd_vel'))
    options = ('--start-offset', '0.5', '-m', 'cmd_vel:=sim/cmd_vel', '-w', '1')
    code, out, _ = play(bag, *FAST, *options, *ACKED)
    assert code == 0
    count = int(out.splitlines()[-1].split()[0])
    assert 25 <= count <= 26
    world.harness.until(lambda: len(received) == count, 'all have come')
    assert twists(received) == COMMANDS[-count:]
    assert real == []


def test_goals_are_played_instead(world, bag, play):
    told = world.harness.listen(Goals, 'goals')
    assert play(bag, '--goals', '-w', '1', *ACKED)[0] == 0
    world.harness.until(lambda: told, 'the goal has come')
    assert told[0].goals[0].pose.position.x == 1.0


@pytest.mark.process
def test_topics_are_played_with_a_clock_in_loops(world, bag):
    """Each round takes as long as the recording: its first message, the goal, comes once in each."""
    harness = world.harness
    received, told = harness.listen(Twist, 'again'), harness.listen(Goals, 'goals')
    clock = harness.listen(Clock, '/clock')
    options = ('-l', '-r', '8', '--clock', '100', '-m', '/cmd_vel:=/again')
    child = world.start('replay_run', str(bag), '--topics', '/cmd_vel', '/goals', *options)
    harness.until(lambda: len(received) > 2 * len(COMMANDS), 'the second round')
    child.signal(signal.SIGINT)
    assert child.exit() == 130
    assert twists(received)[: len(COMMANDS)] == COMMANDS
    times = np.array([one.clock.sec + 1e-9 * one.clock.nanosec for one in clock])
    assert BEGIN <= times.min() < times.max() <= BEGIN + LENGTH + 0.1
    rounds = np.flatnonzero(np.diff(times) < -LENGTH / 2)
    assert len(rounds) + 1 <= len(told) <= len(rounds) + 2


def test_the_clock_does_not_pass_the_end_at_any_rate(bag, play, impatient, monkeypatch):
    signals, publish_time, times = Signals(), Replayer._publish_time, []

    def publish_time_and_interrupt(player):
        publish_time(player)
        times.append(player.position)
        # The bag is played several times meanwhile.
        signals.count = int(len(times) > 20)

    monkeypatch.setattr(Replayer, '_publish_time', publish_time_and_interrupt)
    assert play(bag, '-r', '1e300', '-l', '--clock', '1000', signals=signals)[0] == 130
    assert max(times) - min(times) <= (LENGTH + 0.1) * 1e9


def test_topics_are_published_with_the_strictest_recorded_qos():
    weak = LATCHED._replace(
        reliability=QosReliability.BEST_EFFORT,
        durability=QosDurability.VOLATILE,
        deadline=QosTime(0, 0),
    )
    for recorded, expected in (
        ([weak, LATCHED], ('RELIABLE', 'TRANSIENT_LOCAL', 100_000_000)),
        ([weak], ('BEST_EFFORT', 'VOLATILE', 0)),
        ([], ('RELIABLE', 'VOLATILE', 0)),
    ):
        profile = publisher_profile(recorded, 5)
        deadline = profile.deadline.nanoseconds
        assert (profile.reliability.name, profile.durability.name, deadline) == expected


# --- Subscriptions


class Late(ReplayProgress):
    """Subscribes once more when only that is waited for."""

    def __init__(self, harness):
        self.received = None
        self._harness = harness

    def waiting(self, reason):
        if self.received is None and reason == '/cmd_vel has 1 of 2 subscriptions':
            self.received = self._harness.listen(Twist, 'cmd_vel')

    def toggled(self):
        return False


def test_it_waits_for_the_required_number_of_subscriptions(world, bag):
    first, late = world.harness.listen(Twist, 'cmd_vel'), Late(world.harness)
    result = replay(bag, Playback(rate=20.0), readers=2, acknowledgement_timeout=20.0, progress=late)
    assert (result.played, result.messages) == (True, len(COMMANDS))
    assert result.unacknowledged == ()
    world.harness.until(lambda: len(first) == len(late.received) == len(COMMANDS), 'both have all')


def test_nothing_is_played_to_too_few_subscriptions(bag, play):
    code, out, _ = play(bag, '-w', '2', '--timeout', '0.2')
    assert code == 1
    assert out == 'nothing was played: /cmd_vel has 0 of 2 subscriptions after --timeout 0.2 s\n'
    code, out, _ = play(bag, '-w', '1', signals=interrupted())
    assert code == 130
    assert out == 'interrupted: nothing was played, /cmd_vel has 0 of 1 subscriptions\n'


def test_what_is_unusual_is_reported(world, bag, tmp_path, play, monkeypatch):
    """Missing messages, no subscription, another publisher."""
    monkeypatch.setattr(replay_run, 'MATCH_PATIENCE', 1.5)
    world.harness.peer.create_publisher(Twist, 'cmd_vel', 10)
    path = shutil.copytree(bag, tmp_path / 'run')
    count_more(path, '/cmd_vel', 7)
    code, _, err = play(path, *FAST)
    assert code == 0
    assert 'warning: 7 messages are missing in the bag' in err
    assert 'no node is subscribed to /cmd_vel (-w 1 waits for one)' in err
    assert '/peer also publishes on /cmd_vel' in err
    monkeypatch.setattr(replay_run, 'MATCH_PATIENCE', 0.1)
    code, _, err = play(path, *FAST, '--start-offset', '0.9', '--all-topics')
    assert (code, 'missing' in err) == (0, False)
    assert 'no node is subscribed to /goals' in err


def test_missing_acknowledgements_are_reported(bag, play, impatient, monkeypatch):
    monkeypatch.setattr(Replayer, 'unacknowledged', lambda player: ['/cmd_vel'])
    code, _, err = play(bag, *FAST, '--wait-for-all-acked', '1')
    assert code == 1
    assert 'not all subscriptions to /cmd_vel have acknowledged' in err.splitlines()[-1]
    signals = Signals()

    def unacknowledged(_):
        signals.count = 1
        return ['/cmd_vel']

    # After a signal they are not waited for.
    monkeypatch.setattr(Replayer, 'unacknowledged', unacknowledged)
    assert play(bag, *FAST, '--wait-for-all-acked', '0', signals=signals)[0] == 130


# --- Nothing to play


def test_nothing_to_play_is_an_error(bag, tmp_path, monkeypatch, play):
    monkeypatch.chdir(tmp_path)
    build(tmp_path / 'EMPTY')
    build(tmp_path / 'SPARSE', (1.0, '/goals', Goals()), (2.0, '/goals', Goals()))
    for arguments, words in (
        ((bag, '--goals', '--start-offset', '0.7'), 'no messages of /goals after --start-offset 0.7'),
        (('SPARSE', '--loop'), 'no messages of cmd_vel, only of /goals (--all-topics plays them)'),
        (('SPARSE', '--topics', '/cmd_vel'), 'no messages of /cmd_vel, only of /goals'),
        (('EMPTY', '--all-topics', '--loop'), 'EMPTY has no messages'),
    ):
        code, out, err = play(*arguments)
        assert (code, out, err.count('\n')) == (1, '', 1)
        assert err.startswith('replay_run: error: nothing to play: ')
        assert words in err


# --- Arguments


def test_a_run_is_verified_with_parameters_from_a_file(tmp_path):
    code, out, _ = run('replay_run', REAL, '--verify')
    assert code == 0
    assert out.splitlines()[-1] == 'the robot moves as recorded'
    file = tmp_path / 'slow.yaml'
    file.write_text('virtual_robot:\n  ros__parameters:\n    linear: {x: {max_velocity: 0.05}}\n')
    code, out, _ = run('replay_run', REAL, '--verify', '--params-file', file)
    assert code == 1
    assert 'position: exceeded in' in out
    assert out.splitlines()[-1] == 'the robot moves NOT as recorded'


WRONG = [
    ('BAG --start-offset 99', 'must be less than the length of the bag, 1.000 s'),
    ('BAG --start-offset -1', 'must be zero or positive and finite, got -1.0'),
    ('BAG -r 1e-12', '--rate must be at least '),
    ('BAG --clock 1e-12', '--clock must be in [1e-09, 10000] Hz, got 1e-12'),
    ('FAR -r 0.1', '--rate must be at least 2'),
    ('FAR --clock -r 1e9', 'the bag ends at 9223372036'),
    ('BAG -m /cmd_vel:=~/x{y}', "cannot be played as '~/x{y}': failed to resolve name"),
    ('BAG --topics /nothing', 'has no topic /nothing; it has /cmd_vel'),
    ('BAG -m nonsense', 'must be OLD:=NEW'),
    ('BAG --goals -m cmd_vel:=/x', 'that is played, /goals, got /cmd_vel'),
    ('BAG -m cmd_vel:=/a /cmd_vel:=/b', '/cmd_vel must be remapped once, got /a and /b'),
    ('BAG -m ~/x{y}:=/cmd_vel', 'remapping ~/x{y}:=/cmd_vel: '),
    ('BAG --verify --params-file file.txt', 'file of ROS parameters, got file.txt'),
    ('BAG --goals --verify', 'not allowed with --verify: --goals'),
    ('--verify BAG -r 2', 'not allowed with --verify: -r 2'),
    ('BAG --tolerance 1', 'unrecognized arguments: --tolerance 1'),
]


def test_wrong_arguments_are_reported(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'file.txt').write_text('not a bag')
    build(tmp_path / 'FAR', (1, '/cmd_vel', Twist()), (9_223_372_036, '/cmd_vel', Twist()))
    for arguments, words in WRONG:
        given = [bag if one == 'BAG' else one for one in arguments.split()]
        assert words in refused('replay_run', *given)
