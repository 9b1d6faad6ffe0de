"""The parts of the live page that need neither ROS nor a browser."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest

from diffdrive_jacobian.control import Arrival, circle_path, line_path
from diffdrive_jacobian.control.path_laws import PATH_CONTROLLERS
from diffdrive_jacobian.kinematics import diff_drive, se2
from diffdrive_jacobian.live import robot_state, settings
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
from diffdrive_jacobian.live.node import Pacing
from diffdrive_jacobian.live.quantities import chain, errors, region, rounded
from diffdrive_jacobian.live.robot_state import SPACING, GoalProgress, RobotState, Trail
from diffdrive_jacobian.live.server import page_files
from diffdrive_jacobian.live.session import MAX_COMMANDS, MAX_NOTICES, Session, Snapshot
from diffdrive_jacobian.messages.goal_status import GoalState
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
        ([], 'must be a JSON object'),
        ({'do': 'shutdown'}, "do must be one of .*, got 'shutdown'"),
        ({**DRIVE, 'more': 1}, 'drive must have the keys robot, v, omega'),
        ({**DRIVE, 'v': True}, 'v must be a number'),
        ({**DRIVE, 'v': 10**400}, 'v must be finite, got 1000000'),
        ({**DRIVE, 'v': math.nan}, 'must be JSON'),
        (json.dumps(DRIVE).replace('0.2', '1e999'), r'v must be in \[-1000, 1000\], got inf'),
        ({**DRIVE, 'robot': 7}, 'robot must be a text'),
        ({**DRIVE, 'robot': 'x' * 300}, 'at most 256 printable characters'),
        ({**SET, 'parameter': 'a\ud800'}, 'parameter must be a text of at most 256 printable'),
        ({**SET, 'value': 'a\x1b'}, 'value must be a text of at most 256 printable'),
        ({**SET, 'value': [1]}, 'value must be'),
        ({**GOAL, 'append': 0}, 'append must be True or False, got 0'),
        ({**GOAL, 'theta': 99.0}, r'theta must be in \[-6.28319, 6.28319\] rad, got 99.0'),
        ({**GOAL, 'x': 1e7}, r'x must be in \[-1e\+06, 1e\+06\] m, got 10000000.0'),
        ({'do': 'speed', 'speed': 0}, r'speed must be in \[0.01, 1000\], got 0'),
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


def test_what_was_driven_before_a_goal_that_is_not_canceled_is_stopped(hand):
    assert ask(hand, 10.0) is Act.PUBLISH
    for step in range(30):
        now = 10.1 + 0.1 * step
        hand.command(1, (0.2, 0.0), now=now)
        if (act := ask(hand, now, goal_active=True)) is Act.GIVE_UP:
            break
    assert act is Act.GIVE_UP
    assert hand.moved
    # The key is still held.
    assert hand.command(1, (0.2, 0.0), now=now + 0.1)
    assert ask(hand, now + 0.1) is Act.NOTHING


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


def test_nothing_is_driven_before_an_active_goal_is_canceled(hand):
    assert ask(hand, 10.0, goal_active=True) is Act.CANCEL_GOAL
    assert ask(hand, 10.1, goal_active=True) is Act.NOTHING
    assert ask(hand, 10.2) is Act.PUBLISH
    # It is not canceled.
    hand, acts, waits = HandDriving(), [], round(CANCEL_PATIENCE / 0.1)
    for step in range(2 * waits):
        now = 10.0 + 0.1001 * step
        if step < waits or hand.page is not None:
            hand.command(1, (0.2, 0.0), now=now)
        acts.append(ask(hand, now, goal_active=True))
    nothing = [Act.NOTHING] * (waits - 1)
    assert acts == [Act.CANCEL_GOAL, *nothing, Act.GIVE_UP, *nothing]
    assert not hand.moved


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


# --- Goals


def at(x, y=0.0):
    """Return a single goal."""
    return np.array([[x, y, 0.0]])


def test_goals_and_their_state():
    goal = GoalProgress()
    goal.sent(np.vstack([at(1.0), at(1.0, 1.0)]), (1, 0))
    assert not goal.active
    goal.reported(GoalState.EXECUTING, (1, 0))
    np.testing.assert_array_equal(goal.current, [1.0, 0.0, 0.0])
    goal.moved(np.array([0.99, 0.0, 0.0]), Arrival())
    assert goal.shown()['index'] == 1
    assert len(goal.remaining()) == 1
    goal.reported(GoalState.SUCCEEDED, (1, 0))
    assert goal.current is None
    assert goal.shown()['state'] == 'succeeded'


def test_goals_that_are_replaced_or_refused_leave_the_others():
    goal = GoalProgress()
    goal.sent(at(1.0), (1, 0))
    goal.reported(GoalState.EXECUTING, (1, 0))
    goal.sent(at(2.0), (2, 0))
    goal.reported(GoalState.CANCELED, (1, 0))
    goal.reported(GoalState.ACCEPTED, (2, 0))
    assert goal.active
    np.testing.assert_array_equal(goal.goals, at(2.0))
    goal.sent(at(9.0), (3, 0))
    goal.reported(GoalState.ABORTED, (3, 0))
    np.testing.assert_array_equal(goal.goals, at(2.0))


# --- Numbers


def test_the_chain_is_that_of_document_a():
    numbers = chain(0.0, (0.5, 2.35619449), None, (0.033, 0.16))
    assert numbers['wanted'] == pytest.approx([20.864, 9.440], abs=1e-3)
    assert numbers['world'] == pytest.approx([0.5, 0.0, 2.35619], abs=1e-5)
    identity = np.array(numbers['forward']) @ np.array(numbers['inverse'])
    assert identity == pytest.approx(np.eye(2), abs=1e-5)
    theta, wheels, geometry = 0.7, (3.0, -1.0), (0.05, 0.3)
    numbers = chain(theta, (0.5, 0.0), wheels, geometry)
    expected = diff_drive.wheel_to_world_jacobian(theta, *geometry) @ wheels
    assert numbers['world'] == pytest.approx(expected.tolist(), rel=1e-5)
    assert numbers['measured']
    # Each wheel has its own radius.
    numbers = chain(0.0, (0.5, 0.0), wheels, geometry, (1.1, 0.9))
    right, left = 3.0 * 0.05 * 1.1, -1.0 * 0.05 * 0.9
    assert numbers['twist'] == pytest.approx([(right + left) / 2.0, (right - left) / 0.3], rel=1e-5)
    assert numbers['wanted'] == pytest.approx([0.5 / 0.05 / 1.1, 0.5 / 0.05 / 0.9], rel=1e-5)


def test_the_region_contains_95_percent():
    rng, deviations = np.random.default_rng(1), np.array([0.3, 0.05, 0.2])
    turned = se2.homogeneous([0.0, 0.0, 0.6])
    found = region(turned @ np.diag(deviations**2) @ turned.T)
    assert abs(math.sin(found['angle'] - 0.6)) < 1e-5
    assert found['heading'] == pytest.approx(1.96 * 0.2)
    axes = (rng.normal(size=(20000, 2)) * deviations[:2]) / [found['a'], found['b']]
    assert np.mean(np.sum(axes**2, axis=1) <= 1.0) == pytest.approx(0.95, abs=0.01)
    assert region(np.zeros((3, 3))) is None
    assert region(np.full((3, 3), math.nan)) is None


def test_errors_and_numbers_that_are_short_and_finite():
    found = errors(np.array([0.0, 0.0, 0.5]), np.array([0.0, 2.0, 0.0]), 0.0)
    assert found == pytest.approx((2.0, math.pi / 2 - 0.5))
    assert errors(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.4)[0] == pytest.approx(0.6)
    assert rounded([1.23456789, math.nan, (np.float64(2.0), 3)]) == [1.23457, None, [2.0, 3]]


# --- States of a robot


def test_a_path_is_bounded_and_ends_where_the_robot_is(monkeypatch):
    """Also of odometry that jumps after every few messages."""
    monkeypatch.setattr(robot_state, 'MAX_POINTS', 300)
    for piece in (1, 3, 10**9):
        trail, renewed = Trail(), 0
        for step in range(3600):
            x = 1.1 * SPACING * step + 5.0 * (step // piece)
            before, trail = trail, trail.extended(x, 0.0)
            renewed += trail is not before
            assert len(trail.points) <= 300
            assert trail.points[-1][0] == pytest.approx(x, abs=0.5)
        # A new path is sent to the page as a whole.
        assert renewed < 60
    assert trail.points[0] == (0.0, 0.0)
    trail = trail.extended(0.0, 0.0)
    assert trail.points[-2:] == [None, (0.0, 0.0)]
    assert len(trail.extended(0.0, SPACING / 2).points) == len(trail.points)


def test_the_path_is_interrupted_where_a_robot_is_placed():
    state = RobotState('/')
    for x in (0.0, 0.02, 0.04):
        state.moved(x, np.array([x, 0.0, 0.0]), (1.0, 0.0), None)
    state.interrupt()
    # One message more is from before.
    for time, x in ((0.06, 0.06), (0.08, 0.2), (0.1, 0.22)):
        state.moved(time, np.array([x, 0.0, 0.0]), (1.0, 0.0), None)
    abscissas = [point and point[0] for point in state.trail.points]
    assert abscissas == [0.0, 0.02, 0.04, 0.06, None, 0.2, 0.22]


def test_parameters_of_any_node_may_be_anything():
    state = RobotState('/')
    state.moved(1.0, np.array([1.0, 2.0, 0.5]), (0.3, 0.1), None)
    state.goal.sent(at(2.0, 2.0), (1, 0))
    state.goal.reported(GoalState.EXECUTING, (1, 0))
    usual = state.shown(age=0.0, by_hand=False)
    for value in (math.nan, math.inf, -1.0, 0.0, 1e-300, 1e300, 'x', None, True, [1.0]):
        geometry = ('wheel_radius', 'wheel_separation', 'left_wheel_name')
        state.robot_values = dict.fromkeys(geometry, value)
        names = ('kp', 'kv', 'offset', 'xy_goal_tolerance', 'use_goal_heading')
        for controller in ('go_to_goal', 'pose', 'offset_point', value):
            state.controller_values = {**dict.fromkeys(names, value), 'controller': controller}
            shown = state.shown(age=0.0, by_hand=False)
            json.dumps(shown, allow_nan=False)
            assert shown['geometry'] == usual['geometry']


def test_a_planned_path_is_shown_with_its_errors():
    state = RobotState('/')
    state.goal.sent(circle_path(1.0), (1, 0))
    state.goal.reported(GoalState.EXECUTING, (1, 0))
    state.controller_values = {'controller': 'go_to_goal', 'path_controller': 'kanayama'}
    for x in (0.0, 0.1):
        state.moved(x, np.array([x, -0.05, 0.2]), (1.0, 0.0), None)
    shown = json.loads(json.dumps(state.shown(age=0.0, by_hand=False), allow_nan=False))
    now = shown['now']
    assert (shown['law']['name'], now['bearing_error']) == ('kanayama', None)
    away = math.hypot(0.1, 1.05) - 1.0
    assert now['across'] == pytest.approx(-away, abs=1e-4)
    passed = math.atan2(0.1, 1.05)
    assert now['path_heading_error'] == pytest.approx(0.2 - passed, abs=1e-4)
    assert now['distance'] == pytest.approx(2.0 * math.pi - passed, abs=2e-3)
    places = np.array(shown['goal']['path'])
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1] - 1.0), 1.0, atol=1e-3)
    assert len(shown['goal']['goals']) == 1
    # It has no times.
    assert (now['along'], now['late'], shown['goal']['reference']) == (None, None, None)
    state.goal.sent(at(2.0, 2.0), (2, 0))
    state.goal.reported(GoalState.EXECUTING, (2, 0))
    shown = state.shown(age=0.0, by_hand=False)
    assert (shown['now']['across'], shown['goal'].get('path')) == (None, None)
    assert shown['law']['name'] == 'go_to_goal'


def test_a_trajectory_waits_for_a_robot_that_is_far_from_it():
    state = RobotState('/')
    state.controller_values = {'path_controller': 'pure_pursuit', 'path_approach_distance': 0.2}
    # What was before the path does not count.
    state.moved(2.0, np.zeros(3), (0.0, 0.0), None)
    state.goal.sent(line_path(2.0).timed(0.5), (1, 0))
    state.moved(3.0, np.zeros(3), (0.0, 0.0), None)
    state.goal.reported(GoalState.EXECUTING, (1, 0))

    def moved(time, x):
        state.moved(time, np.array([x, 0.0, 0.0]), (0.5, 0.0), None)
        shown = state.shown(age=0.0, by_hand=False)
        return shown['now'], shown['goal']['reference']

    moved(5.0, 0.0)
    now, reference = moved(5.2, 0.1)
    assert (now['along'], now['late'], reference[0]) == pytest.approx((0.0, 0.0, 0.1), abs=1e-9)
    # It stands: once the times are 0.2 m ahead they wait, a step later.
    for step in range(10):
        now, reference = moved(5.3 + 0.1 * step, 0.1)
    assert reference[0] == pytest.approx(0.35)
    assert now['along'] == pytest.approx(0.1 - 0.35)
    assert now['late'] == pytest.approx(0.5)
    # Nor do the times go on while odometry is missing, beyond odom_timeout.
    state.controller_values = {
        **state.controller_values,
        'path_approach_distance': 9.0,
        'odom_timeout': 0.3,
    }
    now, reference = moved(9.0, 0.1)
    assert reference[0] == pytest.approx(0.35 + 0.5 * 0.3)
    assert now['late'] == pytest.approx(4.0 - 2.0 * reference[0])


def test_the_progress_on_a_path_outlives_a_refused_goal_and_the_same_path_again():
    goal = GoalProgress()
    goal.sent(line_path(4.0), (1, 0))
    goal.reported(GoalState.EXECUTING, (1, 0))
    for x in (0.0, 0.3, 0.6):
        goal.moved(np.array([x, 0.1, 0.0]), Arrival())
    assert goal.path.s == pytest.approx(0.6)
    # While it waits for an answer nothing is known of it.
    goal.sent(at(9.0, 9.0), (2, 0))
    assert goal.path is None
    goal.reported(GoalState.ABORTED, (2, 0))
    goal.reported(GoalState.EXECUTING, (1, 0))
    assert (goal.path.s, goal.active) == (pytest.approx(0.6), True)
    # A planner repeats its path.
    goal.sent(line_path(4.0), (3, 0))
    goal.reported(GoalState.EXECUTING, (3, 0))
    assert goal.path.s == pytest.approx(0.6)
    for other in (line_path(3.0), line_path(4.0).timed(1.0)):
        goal.sent(other, (4, int(other.length)))
        goal.moved(np.array([0.9, 0.0, 0.0]), Arrival())
        assert goal.path.s == 0.0
        goal.reported(GoalState.EXECUTING, (4, int(other.length)))
        goal.moved(np.array([0.4, 0.0, 0.0]), Arrival())
        assert goal.path.s == pytest.approx(0.4)


def test_a_path_whose_status_comes_first_is_a_path():
    goal = GoalProgress()
    goal.reported(GoalState.ACCEPTED, (1, 0))
    assert goal.shown()['goals'] is None
    goal.sent(line_path(4.0), (1, 0))
    goal.reported(GoalState.EXECUTING, (1, 0))
    assert len(goal.shown()['path']) > 100
    assert goal.path is not None


def test_through_waypoints_without_a_stop_the_law_of_paths_drives():
    state = RobotState('/')
    state.controller_values = {
        'controller': 'pose',
        'path_controller': 'kanayama',
        'pass_waypoints': True,
        'waypoint_tolerance': 0.2,
    }
    state.goal.sent(at(1.0, 0.0), (1, 0))
    state.goal.reported(GoalState.EXECUTING, (1, 0))
    assert not state.along_path
    state.goal.sent(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), (2, 0))
    state.goal.reported(GoalState.EXECUTING, (2, 0))
    state.moved(1.0, np.array([0.85, 0.0, 0.0]), (0.1, 0.0), None)
    shown = state.shown(age=0.0, by_hand=False)
    assert (shown['law']['name'], shown['along_path'], shown['goal']['index']) == ('kanayama', True, 1)
    # Of goals that were sent before this program listened nothing is known.
    late = RobotState('/')
    late.controller_values = state.controller_values
    late.goal.reported(GoalState.EXECUTING, (7, 0))
    late.moved(1.0, np.zeros(3), (0.1, 0.0), None)
    assert late.shown(age=0.0, by_hand=False)['law']['name'] == ''


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


def shown_rows(values, **how):
    rows = settings.shown({'controller': values}, **{'path': False, 'imported': False, **how})
    return {row['key'].partition('/')[2]: row for row in rows}


def test_settings_that_are_shown_and_taken():
    values = {'kp': 3.0, 'my_gain': 2.0, 'controller': 'mine', 'linear.x.max_velocity': math.nan}
    rows = shown_rows(values)
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


def test_every_control_has_a_name():
    html = page_files()['index.html'][1].decode()
    for tag in re.findall(r'<(?:button|canvas|select|input)[^>]*>[^<]*', html):
        text = tag.split('>', 1)[1].strip()
        labelled = 'aria-label' in tag or any(letter.isalpha() for letter in text)
        within_label = re.search(rf'<label>[^\n]*{re.escape(tag)}', html)
        assert labelled or within_label, tag
