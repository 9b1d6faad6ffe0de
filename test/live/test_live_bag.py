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

"""A bag on the live page."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.lockstep_nodes import QUICK, make_complete
from support.recorded import LockstepRecording
from support.ros_messages import twist

from diffdrive_jacobian.bags import read_run
from diffdrive_jacobian.control import line_path
from diffdrive_jacobian.drives import drive
from diffdrive_jacobian.live.bag_player import BagPlayer, RecordedRobot, read_robots
from diffdrive_jacobian.live.commands import CancelGoal, Pause, Seek, SetSpeed, Step
from diffdrive_jacobian.live.session import Session
from diffdrive_jacobian.messages.codecs import Changes
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.recording.recording import Recording

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A drive over two goals."""
    path = tmp_path_factory.mktemp('live') / 'tour'
    recording = Recording(path, lossless=True)
    drive([[0.4, 0.0], [0.4, 0.4]], lockstep=True, parameters=QUICK, recording=recording)
    recording.finish()
    return path


class Player:
    """A player with a page."""

    def __init__(self, bag, robots):
        self.session = Session()
        self.player = BagPlayer(self.session, bag, robots)
        self.player.advance(0.0)

    def send(self, *commands):
        for command in commands:
            self.player._obey(command)
        self.player.advance(0.0)

    @property
    def snapshot(self):
        return self.session.latest()[1]

    @property
    def robot(self):
        return self.snapshot.robots[0]

    @property
    def world(self):
        return self.snapshot.world

    @property
    def settings(self):
        return {row['key']: row for row in self.snapshot.fixed['settings']['/']}


@pytest.fixture(scope='module')
def robots(bag):
    return read_robots(bag)


@pytest.fixture
def player(bag, robots):
    return Player(bag, robots)


def test_the_robot_is_where_it_was(bag, player):
    odometry = read_run(bag).odometry
    times = (odometry.stamps - odometry.stamps[0]) * 1e-9
    for index in (0, 20, len(odometry) - 1):
        player.send(Seek(float(times[index]) + 1e-6))
        assert player.robot['pose'] == pytest.approx(odometry.values[index, :3].tolist(), abs=1e-5)
        twist = [player.robot['now'][name] for name in ('v', 'omega')]
        assert twist == pytest.approx(odometry.values[index, 3:].tolist(), abs=1e-4)
    assert player.robot['region']['a'] > 0.0


def test_goals_and_the_chain_are_as_recorded(player):
    player.send(Seek(0.2))
    robot = player.robot
    assert robot['goal']['goals'] == [
        pytest.approx([0.4, 0.0, math.pi / 2], abs=1e-5),
        [0.4, 0.4, 0.0],
    ]
    assert (robot['goal']['index'], robot['goal']['state']) == (0, 'executing')
    assert robot['law']['gains']['K_p'] == QUICK['kp']
    assert robot['commanded']
    chain = robot['chain']
    assert np.array(chain['forward']) @ chain['wheels'] == pytest.approx(chain['twist'], rel=1e-4)
    player.send(Seek(player.world['duration']))
    assert player.robot['goal']['index'] == 1
    assert player.robot['goal']['state'] == 'succeeded'
    # It has no ground truth.
    assert player.robot['truth'] is None
    assert player.snapshot.true_trails['/'].points == []


def test_time_plays_pauses_steps_and_jumps_and_nothing_is_steered(player):
    assert player.world['time'] == 0.0
    player.player.advance(0.1)
    assert player.world['time'] == pytest.approx(0.1)
    player.send(SetSpeed(2.0))
    player.player.advance(0.1)
    assert player.world['time'] == pytest.approx(0.3)
    player.send(Pause(paused=True))
    player.player.advance(5.0)
    assert player.world['time'] == pytest.approx(0.3)
    player.send(Step())
    assert player.world['time'] == pytest.approx(0.32, abs=1e-3)
    player.send(Seek(1e6), Pause(paused=False))
    assert player.world['time'] == 0.0
    player.player.advance(1e6)
    assert player.world['paused']
    assert player.world['time'] == player.world['duration']
    version = player.session.latest()[0]
    player.player.advance(1.0)
    assert player.session.latest()[0] == version
    player.send(CancelGoal('/'))
    assert 'this is a recording' in player.session.notices_after(0)[0]['text']


def test_curves_and_parameters_of_the_whole_bag(player):
    fixed = player.snapshot.fixed
    strips = fixed['strips']['/']
    # A page draws the same curves of a bag and of a robot that runs.
    assert {*strips} == {'time', *player.robot['now']}
    assert len({len(curve) for curve in strips.values()}) == 1
    assert strips['distance'][0] == pytest.approx(0.4, abs=0.05)
    assert max(value for value in strips['left'] if value is not None) > 1.0
    assert player.settings['controller/kp']['value'] == QUICK['kp']
    assert fixed['bag'] == 'tour'
    trail = player.snapshot.trails['/']
    player.send(Seek(player.world['duration']))
    assert player.robot['travelled'] == len(trail.points)


def test_a_trajectory_is_replayed_with_its_law_errors_and_times(tmp_path):
    """Also what waits: the robot cannot keep the times."""
    recording = Recording(tmp_path / 'along', lossless=True)
    parameters = {'path_controller': 'kanayama', 'linear.x.max_velocity': 0.2}
    drive(line_path(2.0).timed(0.8), lockstep=True, parameters=parameters, recording=recording)
    recording.finish()
    (robot,) = read_robots(recording.bag)
    line = robot.run.timeline()
    # Its gain was changed on the way.
    received = int(robot.run.odometry.received[40])
    change = (received, Changes('/go_to_goal', {'k_y': 7.0}, received))
    run = replace(robot.run, parameter_events=(change,))
    player = Player(recording.bag, [RecordedRobot('/', run, robot.start)])
    late = []
    for index in (5, 60, 20, 90):
        player.send(Seek(float(robot.time[index]) + 1e-6))
        now = player.robot['now']
        for name in ('across', 'along', 'path_heading_error', 'late'):
            assert now[name] == pytest.approx(getattr(line, name)[index], abs=1e-5), name
        late.append(now['late'])
        assert player.robot['goal']['reference'][0] == pytest.approx(0.8 * line.elapsed[index], abs=1e-5)
        law = player.robot['law']
        assert (law['name'], law['gains']['k_y']) == ('kanayama', 7.0 if index >= 40 else 25.0)
        assert next(iter(player.settings)) == 'controller/k_x'
        assert player.settings['controller/k_y']['value'] == law['gains']['k_y']
    assert late[0] == 0.0 < late[-1]
    # After the end it has arrived, and nothing else is driven.
    player.send(Seek(1e6))
    goal = player.robot['goal']
    assert (goal['state'], goal['active'], goal['reference']) == ('succeeded', False, None)
    assert goal['path'][-1] == [2.0, 0.0]
    assert player.robot['law']['name'] == 'kanayama'
    assert robot.strips()['late'][90] == pytest.approx(late[-1])


def test_several_robots_with_and_without_ground_truth(lockstep, tmp_path):
    bag = tmp_path / 'two'
    lockstep.add(make_complete(VirtualRobot, '/one', simulate_slip=True, wheel_travel_variance=2e-3))
    lockstep.add(make_complete(VirtualRobot, '/two', y=1.0))
    made = LockstepRecording(lockstep, bag, everything=True)
    made.look()
    lockstep.publish('/one/cmd_vel', twist(0.5, 0.0))
    lockstep.run_for(0.4)
    made.recording.finish()
    player = Player(bag, read_robots(bag))
    player.send(Seek(0.4))
    one, two = player.snapshot.robots
    assert (one['name'], two['name']) == ('/one', '/two')
    assert two['pose'] == [0.0, 1.0, 0.0]
    assert two['truth'] is None
    run = read_run(bag, namespace='/one')
    assert len(player.snapshot.true_trails['/one'].points) == len(run.ground_truth)
    latest = np.searchsorted(run.ground_truth.stamps, run.odometry.stamps[0] + 400_000_000, 'right') - 1
    truth = run.ground_truth.values[latest, :3]
    assert one['truth'] == pytest.approx(truth.tolist(), abs=1e-5)
    assert one['truly_travelled'] == latest + 1
    assert one['pose'] != one['truth']
