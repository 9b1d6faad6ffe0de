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

"""Parts of the live page without ROS and browser: commands, driving by hand, pace, session, settings."""

from __future__ import annotations

import json
import math
import re

import pytest

from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.live import settings
from diffdrive_jacobian.live.commands import (
    CommandError,
    DriveByHand,
    Pause,
    Seek,
    SendGoal,
    SetParameter,
    SetSpeed,
    Step,
    parse,
)
from diffdrive_jacobian.live.hand import CANCEL_PATIENCE, DEAD_MAN, Act, HandDriving
from diffdrive_jacobian.live.pacing import Pacing
from diffdrive_jacobian.live.robot_state import Trail
from diffdrive_jacobian.live.server import page_files
from diffdrive_jacobian.live.session import MAX_COMMANDS, MAX_NOTICES, Session, Snapshot
from diffdrive_jacobian.parameters.go_to_goal import GoToGoalParameters

# --- Commands of the page

GOAL = {'do': 'goal', 'robot': '/', 'x': 1, 'y': -2.5, 'theta': None, 'append': False}
DRIVE = {'do': 'drive', 'robot': '/a', 'v': 0.2, 'omega': -1.0}
SET = {'do': 'set', 'robot': '/', 'parameter': 'c/kp', 'value': 3}


def test_commands_are_parsed():
    for content, command in (
        (GOAL, SendGoal('/', 1.0, -2.5, None, append=False)),
        ({**GOAL, 'theta': 3.0, 'append': True}, SendGoal('/', 1.0, -2.5, 3.0, append=True)),
        (DRIVE, DriveByHand('/a', 0.2, -1.0)),
        ({'do': 'pause', 'paused': True}, Pause(paused=True)),
        ({'do': 'step'}, Step()),
        ({'do': 'speed', 'speed': 5}, SetSpeed(5.0)),
        ({'do': 'seek', 'time': 0}, Seek(0.0)),
        ({**SET, 'value': None}, SetParameter('/', 'c/kp', None)),
        (SET, SetParameter('/', 'c/kp', 3.0)),
    ):
        assert parse(json.dumps(content)) == command


@pytest.mark.parametrize(
    ('content', 'words'),
    [
        (b'{}', 'must be text'),
        ('[' * 3000, 'must be JSON'),
        ([], 'object'),
        ({'do': 'shutdown'}, "do must be one of .*, got 'shutdown'"),
        ({**DRIVE, 'more': 1}, 'keys robot, v, omega'),
        ({**DRIVE, 'v': True}, 'v must be a number'),
        ({**DRIVE, 'v': 10**400}, 'v must be finite'),
        ({**DRIVE, 'v': math.nan}, 'JSON'),
        (json.dumps(DRIVE).replace('0.2', '1e999'), 'v must be in'),
        ({**DRIVE, 'robot': 7}, 'robot must be a text'),
        ({**DRIVE, 'robot': 'x' * 300}, 'at most 256'),
        ({**SET, 'value': 'a\x1b'}, 'value .* printable'),
        ({**SET, 'value': [1]}, 'value'),
        ({**GOAL, 'append': 0}, 'append'),
        ({**GOAL, 'theta': 99.0}, r'theta must be in \[-6.28319, 6.28319\] rad, got 99.0'),
        ({**GOAL, 'x': 1e7}, 'x must be in'),
        ({'do': 'speed', 'speed': 0}, 'speed must be in'),
    ],
)
def test_other_commands_are_refused(content, words):
    with pytest.raises(CommandError, match=words) as caught:
        parse(content if isinstance(content, str | bytes) else json.dumps(content))
    assert str(caught.value).isprintable()


# --- Driving by hand


def ask(hand, now, robot_time=None, *, goal_active=False, is_open=True):
    """Ask what to do at a time, by the clock of the robot likewise unless it is given."""
    robot_time = now if robot_time is None else robot_time
    return hand.update(now, robot_time, lambda page: is_open, goal_active=goal_active)


@pytest.fixture
def hand():
    """The first page drives since 10 s."""
    hand = HandDriving()
    assert hand.command(1, (0.2, 0.0), now=10.0)
    return hand


def test_driving_ends_when_the_page_is_silent_or_closed(hand):
    assert ask(hand, 10.0) is Act.PUBLISH
    assert ask(hand, 10.01) is Act.NOTHING
    assert ask(hand, 10.0 + 0.9 * DEAD_MAN) is Act.PUBLISH
    assert ask(hand, 10.0 + 1.1 * DEAD_MAN) is Act.EXPIRE
    assert hand.page is None
    assert ask(hand, 11.0) is Act.NOTHING
    assert hand.command(2, (0.2, 0.0), now=11.0)
    assert ask(hand, 11.0) is Act.PUBLISH
    assert ask(hand, 11.01, is_open=False) is Act.STOP


def test_a_page_that_was_silent_must_release_the_keys_before_it_drives_again(hand):
    """It was frozen with a key held, and goes on asking as soon as it is back."""
    assert ask(hand, 10.0) is Act.PUBLISH
    assert ask(hand, 11.0) is Act.EXPIRE
    for tenth in range(20):
        assert hand.command(1, (0.2, 0.0), now=11.0 + tenth / 10)
        assert ask(hand, 11.0 + tenth / 10) is Act.NOTHING
    hand.release(1)
    assert ask(hand, 13.0) is Act.NOTHING
    assert hand.command(1, (0.1, 0.0), now=13.0)
    assert ask(hand, 13.0) is Act.PUBLISH
    assert hand.twist == (0.1, 0.0)


def test_a_silence_that_the_program_has_slept_through_ends_the_driving_too(hand):
    """The first command after it comes before the first look."""
    assert ask(hand, 10.0) is Act.PUBLISH
    assert hand.command(1, (0.2, 0.0), now=15.0)
    assert ask(hand, 15.0) is Act.EXPIRE
    assert hand.command(1, (0.2, 0.0), now=15.1)
    assert ask(hand, 15.1) is Act.NOTHING


def test_nothing_is_driven_before_an_active_goal_is_canceled(hand):
    assert ask(hand, 10.0, goal_active=True) is Act.CANCEL_GOAL
    assert ask(hand, 10.1, goal_active=True) is Act.NOTHING
    assert ask(hand, 10.2) is Act.PUBLISH


@pytest.mark.parametrize('moved', [False, True])
def test_driving_is_given_up_if_the_goal_is_not_canceled(hand, moved):
    """The caller must know whether there is a motion to stop. The key is still held."""
    if moved:
        assert ask(hand, 10.0) is Act.PUBLISH
    acts, waits = [], round(CANCEL_PATIENCE / 0.1)
    for step in range(2 * waits):
        now = 10.0 + 0.1001 * step
        hand.command(1, (0.2, 0.0), now=now)
        acts.append(ask(hand, now, goal_active=True))
    nothing = [Act.NOTHING] * (waits - 1)
    assert acts == [Act.CANCEL_GOAL, *nothing, Act.GIVE_UP, *nothing]
    assert hand.moved == moved


def test_commands_are_spaced_by_the_clock_of_the_robot(hand):
    """However often it is asked, and also if the clock is set back to 1.0."""
    times = (5.0, 5.0, 5.03, 5.041, 5.05, 1.0, 1.03, 1.05)
    assert [time for time in times if ask(hand, 10.0, time) is Act.PUBLISH] == [5.0, 5.041, 1.0, 1.05]


def test_one_page_drives_at_a_time_until_it_releases(hand):
    ask(hand, 10.0)
    assert not hand.command(2, (0.9, 0.0), now=10.01)
    hand.release(2)
    assert hand.twist == (0.2, 0.0)
    hand.release(1)
    assert ask(hand, 10.06) is Act.STOP
    assert hand.command(2, (0.9, 0.0), now=10.3)


# --- Pace


def test_time_passes_at_the_speed_that_was_chosen():
    pacing = Pacing(speed=2.0)
    assert pacing.may_advance(5.0, now=100.0)
    assert not pacing.may_advance(5.02, now=100.005)
    assert pacing.may_advance(5.02, now=100.01)
    pacing.obey(SetSpeed(0.5))
    assert pacing.may_advance(5.02, now=100.01)
    assert not pacing.may_advance(5.04, now=100.03)
    assert pacing.may_advance(5.04, now=100.051)
    # A machine that was busy does not race afterwards.
    assert pacing.may_advance(5.06, now=109.0)
    assert not pacing.may_advance(5.08, now=109.01)


def test_pause_and_steps():
    pacing = Pacing()
    pacing.obey(Pause(paused=True))
    assert not pacing.may_advance(1.0, now=0.0)
    pacing.obey(Step())
    pacing.obey(Step())
    assert [pacing.may_advance(1.0, now=float(k)) for k in range(3)] == [True, True, False]
    assert pacing.shown()['paused']
    # The wait ends when the program does.
    assert pacing.pace(0.0, lambda: True)
    pacing.obey(Pause(paused=False))
    assert pacing.may_advance(1.0, now=5.0)


# --- Sessions


def test_a_page_receives_only_what_is_new():
    session = Session()
    trail = Trail().extended(0.0, 0.0)
    session.store(Snapshot(robots=[{'name': '/'}], trails={'/': trail}, fixed={'bag': 'x'}))
    page = session.enter()
    first = page.frame(session)
    assert first['fixed'] == {'bag': 'x'}
    assert first['paths'] == {'/': {'new': True, 'points': [(0.0, 0.0)]}}
    assert page.frame(session) is None
    trail.extended(1.0, 0.0, jump=2.0)
    session.store(Snapshot(trails={'/': trail}, fixed={'bag': 'x'}))
    session.notify('something')
    second = page.frame(session)
    assert 'fixed' not in second
    assert second['paths'] == {'/': {'new': False, 'points': [(1.0, 0.0)]}}
    assert [notice['text'] for notice in second['notices']] == ['something']
    assert 'notices' not in session.enter().frame(session)


def test_commands_and_notices_are_bounded():
    session = Session()
    page = session.enter()
    taken = [session.put(page, Step()) for _ in range(MAX_COMMANDS + 5)]
    assert taken.count(False) == 5
    assert len(session.take_commands()) == MAX_COMMANDS
    assert session.take_commands() == []
    for _ in range(3 * MAX_NOTICES):
        session.notify('again')
    assert len(session.notices_after(0)) == MAX_NOTICES
    session.leave(page)
    assert not session.watched


# --- Settings


def shown_rows(values, *, path=False):
    rows = settings.shown({'controller': values}, path=path, imported=False)
    return {row['key'].partition('/')[2]: row for row in rows}


def test_settings_that_are_shown_and_taken():
    values = {'kp': 3.0, 'my_gain': 2.0, 'controller': 'mine', 'linear.x.max_velocity': math.nan}
    rows = shown_rows({**values, 'other_gain': math.nan, 'Odd.name': 1.0})
    # Of a law that is not known here what is no parameter of every go_to_goal, which kp is.
    assert set(rows) == {'my_gain', 'controller', 'linear.x.max_velocity'}
    assert rows['controller']['choices'][-1] == 'mine'
    assert rows['linear.x.max_velocity']['value'] is None
    own = {'controller': 'go_to_goal'}
    assert settings.find('controller/kp', own).checked(2.0) == 2.0
    assert math.isnan(settings.find('robot/max_wheel_velocity', own).checked(None))
    for key, value in (('controller/kp', None), ('controller/kp', 'a'), ('controller/controller', 1.0)):
        with pytest.raises(settings.SettingError):
            settings.find(key, own).checked(value)
    for unknown in ('controller/use_sim_time', 'controller/k_x', 'kp', ''):
        with pytest.raises(settings.SettingError, match='there is no setting'):
            settings.find(unknown, own)


@pytest.mark.parametrize('law', PATH_CONTROLLERS, ids=lambda one: one.name)
def test_on_a_path_its_law_and_gains_come_first_and_those_of_goals_are_folded(law):
    values = {name: one.default for name, one in GoToGoalParameters().declared().items()} | {
        'path_controller': law.name,
        'controller': 'pose',
    }
    driven, idle = shown_rows(values, path=True), shown_rows(values)
    own = [gain.name for gain in law.gains]
    assert [*driven][: len(own) + 2] == [*own, 'path_controller', 'path_speed']
    assert {driven[name]['group'] for name in (*own, 'path_controller')} == {''}
    assert {driven[name]['group'] for name in ('kp', 'kv', 'controller')} == {'For goals'}
    assert [*idle][:2] == ['kp', 'kv']
    assert {idle[name]['group'] for name in (*own, 'path_controller')} == {'Along a path'}
    assert {*driven} == {*idle}
    # It can be set at any time.
    for name in own:
        assert settings.find(f'controller/{name}', values).checked(1.5) == 1.5
    assert set(driven['path_controller']['choices']) >= {one.name for one in PATH_CONTROLLERS}


# --- Files of the page


def test_the_page_loads_nothing_from_elsewhere():
    found = page_files()
    assert {'index.html', 'main.js', 'theme.css', 'icon.svg'} <= set(found)
    for name, (_, content) in found.items():
        text = content.decode().replace('http://www.w3.org/2000/svg', '')
        assert not re.search(r'https?:|//\w+\.\w|@import|url\(', text), name
