"""The law that takes a position and a heading (Aicardi et al. 1995), alone and through the nodes."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from support.lockstep_nodes import (
    ACCEPTED,
    EXECUTING,
    SUCCEEDED,
    Controller,
    Topics,
    add_team,
    arrives,
    make,
)
from support.ros_messages import goal, goals, pose_of

from diffdrive_jacobian.control import (
    Arrival,
    VelocityLimits,
    Waypoints,
    go_to_goal,
    go_to_pose,
    turn_in_place,
)
from diffdrive_jacobian.kinematics import se2
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.simulation import closed_loops, trajectories

KP, KV = 3.0, 0.5
COUNT = 10_000
LIMITS = VelocityLimits(min_v=-0.22, max_v=0.22, min_omega=-2.84, max_omega=2.84, max_wheel_speed=6.67)
STARTS = [(0.0, 0.0, math.pi), (0.5, -0.8, 2.0)]


def random_poses(seed, count=COUNT, size=3.0):
    """Starts and goals that have nothing to do with each other."""
    rng = np.random.default_rng(seed)
    box = [size, size, np.pi]
    return rng.uniform(np.negative(box), box, (2, count, 3))


def random_gains(seed, count=COUNT):
    """Sluggish and wild ones, and weights of the heading."""
    return 10.0 ** np.random.default_rng(seed).uniform(-1.5, 1.5, (3, count))


def polar(states, targets):
    """Distance, bearing seen from the robot, the same seen from the goal's heading (all independent)."""
    way = (targets[..., 0] - states[..., 0]) + 1j * (targets[..., 1] - states[..., 1])
    alpha = np.angle(way * np.exp(-1j * states[..., 2]))
    phi = np.angle(way * np.exp(-1j * targets[..., 2]))
    return np.abs(way), alpha, phi


def energy(states, targets, h):
    rho, alpha, phi = polar(states, targets)
    return rho**2 + alpha**2 + h * phi**2


def differences(poses, targets):
    """How far poses are from others (m), and by which angle (rad)."""
    return np.hypot(*(poses - targets).T[:2]), np.abs(se2.wrap_angle((poses - targets)[..., 2]))


# --- The law


def test_the_law_is_that_of_aicardi_with_document_as_speed():
    (states, targets), (Kp, Kv, h) = random_poses(1), random_gains(2)
    rho, alpha, phi = polar(states, targets)
    bend = Kv * np.cos(alpha) * np.sin(alpha) / alpha
    v, omega = go_to_pose(states, targets, Kp, Kv, h)
    np.testing.assert_allclose(v, Kv * rho * np.cos(alpha), rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(omega, Kp * alpha + bend * (alpha + h * phi), rtol=1e-10, atol=1e-10)
    assert np.array_equal(v, go_to_goal(states, targets[:, :2], Kp, Kv)[0])


def test_without_a_weight_the_heading_converges_at_critical_damping_or_twice_as_fast_as_the_distance():
    (states, targets), (Kp, Kv, _) = random_poses(1), random_gains(2)
    ratio = Kp / Kv
    assert 0.1 < np.mean(ratio > 4.0) < 0.9
    weight = np.where(ratio <= 4.0, (ratio / 2.0) ** 2, 2.0 * ratio - 4.0)
    given = go_to_pose(states, targets, Kp, Kv, weight)
    np.testing.assert_allclose(go_to_pose(states, targets, Kp, Kv), given, rtol=1e-9, atol=1e-9)
    # Near the goal heading and bearing settle like s^2 + Kp s + Kv^2 h: see where its roots lie.
    for kp, kv, h in zip(Kp[:500], Kv[:500], weight[:500], strict=True):
        slowest = np.roots([1.0, kp, kv * kv * h]).real.max()
        expected = -kp / 2.0 if kp <= 4.0 * kv else -2.0 * kv
        assert slowest == pytest.approx(expected, rel=1e-6)


GAINS = (6.0, 12.0, 24.0, 45.0)


@cache
def arrived_forwards():
    """Drive 500 robots with each gain at once; a row for each gain."""
    states, targets = random_poses(11, 500)
    found = closed_loops(
        go_to_pose,
        states,
        targets,
        np.array(GAINS)[:, np.newaxis],
        0.5,
        arrival=Arrival(use_heading=True),
        limits=VelocityLimits(min_v=0.0),
    )
    return states, found.arrived


@pytest.mark.parametrize('Kp', GAINS)
def test_a_robot_that_may_not_back_up_takes_poses_all_the_same_whatever_the_gains(Kp):
    states, arrived = arrived_forwards()
    assert arrived.shape == (4, 500)
    arrived = arrived[GAINS.index(Kp)]
    assert arrived.all(), states[~arrived]


def test_the_lyapunov_function_never_grows_along_the_polar_equations():
    (states, targets), (Kp, Kv, h) = random_poses(3), random_gains(4)
    rho, alpha, phi = polar(states, targets)
    v, omega = go_to_pose(states, targets, Kp, Kv, h)
    rho_dot = -v * np.cos(alpha)
    phi_dot = v * np.sin(alpha) / rho
    alpha_dot = phi_dot - omega
    terms = 2.0 * np.array([rho * rho_dot, alpha * alpha_dot, h * phi * phi_dot])
    rounding = 1e-12 * np.abs(terms).max(axis=0)
    V_dot = terms.sum(axis=0)
    assert np.all(V_dot <= rounding)
    # In closed form: what holds it where it is.
    exact = -2.0 * (Kv * (rho * np.cos(alpha)) ** 2 + Kp * alpha**2)
    assert np.all(np.abs(V_dot - exact) <= rounding)
    # The polar equations are the robot's motion.
    dt = 1e-7
    moved = se2.integrate(states, np.stack([v, omega], -1), dt)
    rates = (np.array(polar(moved, targets)) - [rho, alpha, phi]) / dt
    smooth = (np.pi - np.abs([alpha, phi])).min(axis=0) > 0.01
    scale = 1e-4 * (1.0 + (np.abs(v) / rho + np.abs(omega)) ** 2)
    for rate, expected in zip(rates, (rho_dot, alpha_dot, phi_dot), strict=True):
        assert np.all(np.abs(rate - expected)[smooth] <= (scale * (1.0 + rho))[smooth])
    assert np.count_nonzero(smooth) > 0.98 * COUNT


@pytest.mark.parametrize(('Kp', 'Kv', 'h'), [(3.0, 0.5, 9.0), (2.0, 1.0, 1.0)])
def test_sampled_finely_the_energy_falls_at_every_step_until_the_pose_is_taken(Kp, Kv, h):
    states, targets = random_poses(5, 100)
    gone = trajectories(
        go_to_pose,
        *(states, targets, Kp, Kv, h),
        rate=100.0,
        duration=40.0,
        arrival=Arrival(xy_tolerance=1e-4),
    )
    V = energy(gone.poses, targets, h)
    assert np.all(np.diff(V, axis=0) <= 1e-5 * V[:-1])
    assert np.all(V[-1] < 1e-4 * V[0])
    assert gone.outcomes.arrived.all()


def test_the_law_alone_takes_position_and_heading_from_1000_starts():
    states, targets = random_poses(6, 1000)
    end = closed_loops(
        go_to_pose, states, targets, KP, KV, duration=30.0, arrival=Arrival(xy_tolerance=0.0)
    ).pose
    off, turned = differences(end, targets)
    assert off.max() < 1e-3
    assert turned.max() < 1e-6


def test_states_goals_gains_and_weights_broadcast():
    (states, targets), (Kp, Kv, h) = random_poses(7, 4), random_gains(8, 4)
    grid = go_to_pose(states[:3, np.newaxis], targets, Kp[:3, np.newaxis], Kv, h)
    default = go_to_pose(states[:3, np.newaxis], targets, Kp, Kv[:3, np.newaxis])
    for i, j in np.ndindex(3, 4):
        one = go_to_pose(states[i], targets[j], Kp[i], Kv[j], h[j])
        np.testing.assert_allclose([part[i, j] for part in grid], one, rtol=1e-12)
        one = go_to_pose(states[i], targets[j], Kp[j], Kv[i])
        np.testing.assert_allclose([part[i, j] for part in default], one, rtol=1e-12)
        assert type(one[0]) is type(one[1]) is float


def test_exactly_on_the_position_it_stands_still_whatever_the_headings():
    states, targets = random_poses(9, 1000)
    targets[:, :2] = states[:, :2]
    v, omega = go_to_pose(states, targets, KP, KV)
    assert not v.any()
    assert not omega.any()
    for theta in (0.0, -0.0, math.pi, -math.pi, 2.0):
        for x in (0.0, -0.0):
            assert go_to_pose([x, x, theta], [0.0, -0.0, 1.0], KP, KV) == (0.0, 0.0)


def test_towards_alpha_zero_there_is_no_hole():
    for alpha in (0.0, 1e-300, -1e-300, 1e-12, -1e-9, 1e-6):
        v, omega = go_to_pose([-1.0, 0.0, -alpha], [0.0, 0.0, 0.4], KP, KV, 2.0)
        assert v == pytest.approx(KV)
        assert omega == pytest.approx(KP * alpha + KV * (alpha + 2.0 * -0.4), abs=1e-11)


def test_a_goal_exactly_behind_is_backed_up_to_while_turning():
    for y in (0.0, -0.0):
        v, omega = go_to_pose([2.0, y, 0.0], [0.0, 0.0, 0.3], KP, KV)
        assert v == -2.0 * KV
        assert abs(omega) == pytest.approx(KP * math.pi)
    # On either side of it the turn is to that side, and the energy knows no jump.
    left, right = (go_to_pose([2.0, y, 0.0], [0.0, 0.0, 0.0], KP, KV) for y in (-1e-12, 1e-12))
    assert left[1] == pytest.approx(-right[1])
    assert abs(left[1]) == pytest.approx(KP * math.pi)
    sides = [energy(np.array([2.0, y, 0.0]), np.zeros(3), 9.0) for y in (-1e-9, 1e-9)]
    assert sides[0] == pytest.approx(sides[1], rel=1e-8)


def test_moved_to_another_place_or_mirrored_the_law_is_the_same():
    states, targets = random_poses(10)
    here = np.array(go_to_pose(states, targets, KP, KV))
    there = random_poses(11)[0]
    moved = go_to_pose(se2.compose(there, states), se2.compose(there, targets), KP, KV)
    np.testing.assert_allclose(moved, here, rtol=1e-8, atol=1e-8)
    mirror = np.array([1.0, -1.0, -1.0])
    mirrored = go_to_pose(mirror * states, mirror * targets, KP, KV)
    # Not every library's sine is exactly odd.
    np.testing.assert_allclose(mirrored, [here[0], -here[1]], rtol=1e-12, atol=1e-12)


# --- Closed loops


@pytest.mark.parametrize(
    ('limits', 'count'), [(VelocityLimits(), COUNT), (LIMITS, 500)], ids=['free', 'limited']
)
def test_from_10000_random_starts_10000_random_poses_are_all_taken(limits, count):
    # Under limits the paths are shorter: several of them take long all the same.
    states, targets = random_poses(12, count, 1.5 if limits == LIMITS else 3.0)
    found = closed_loops(
        go_to_pose,
        *(states, targets, KP, KV),
        arrival=Arrival(use_heading=True),
        limits=limits,
        duration=90.0,
    )
    off, turned = differences(found.pose, targets)
    failed = np.flatnonzero(~found.arrived | (off > 0.02) | (turned > 0.02))
    assert not failed.size, [(states[i].tolist(), targets[i].tolist()) for i in failed]


def test_near_goals_headings_beside_pi_and_other_gains_are_taken_too():
    count = 1000
    states, targets = random_poses(13, count, 0.05)
    states[::2, 2], targets[::3, 2] = np.pi, -np.pi
    states[::5, :2], targets[::7, :2] = [0.3, 0.0], 0.0
    rng = np.random.default_rng(14)
    Kv = rng.uniform(0.3, 2.0, count)
    Kp = Kv * rng.uniform(1.0, 10.0, count)
    found = closed_loops(go_to_pose, states, targets, Kp, Kv, arrival=Arrival(use_heading=True))
    failed = np.flatnonzero(~found.arrived)
    assert not failed.size, [(states[i].tolist(), targets[i].tolist(), Kp[i], Kv[i]) for i in failed]


def test_limits_slow_the_robot_down_on_the_same_path():
    """To first order in the sampling time: a slower robot is controlled more often along its path."""
    count = 10
    states, targets = random_poses(15, count, 1.0)
    slower = VelocityLimits(min_v=-0.1, max_v=0.1, min_omega=-0.5, max_omega=0.5, max_wheel_speed=4.0)

    def deviation(rate):
        free, slow = (
            trajectories(go_to_pose, states, targets, KP, KV, rate=rate, limits=limits)
            for limits in (VelocityLimits(), slower)
        )
        assert slow.outcomes.arrived.all()
        assert np.all(slow.outcomes.time >= free.outcomes.time - 1.0 / rate)
        assert slow.outcomes.time.mean() > 1.5 * free.outcomes.time.mean()
        # From each tenth of a second of the limited path to the nearest point of the unlimited one.
        paths = [one.poses[..., :2] @ [1.0, 1j] for one in (free, slow)]
        return max(
            np.abs(paths[0][:, i, np.newaxis] - paths[1][:: int(rate / 10.0), i]).min(axis=0).max()
            for i in range(count)
        )

    coarse, fine = deviation(50.0), deviation(100.0)
    assert coarse < 0.02
    assert coarse / fine == pytest.approx(2.0, rel=0.2)


# --- Bad input

GOOD = {'state': np.zeros((2, 3)), 'goal': [1.0, 1.0, 0.0], 'Kp': 3.0, 'Kv': 0.5, 'h': 2.0}


@pytest.mark.parametrize(
    ('name', 'bad', 'message'),
    [
        *(
            (name, bad, rf'^{name} must be positive and finite, got {bad}$')
            for name in ('Kp', 'Kv', 'h')
            for bad in (0.0, -1.0, math.nan, math.inf)
        ),
        *(
            (name, [1.0, -2.0], rf'^{name} must be positive and finite, got -2.0 at index 1$')
            for name in ('Kp', 'Kv', 'h')
        ),
        *(
            (name, np.ones(3), rf'and {name}.* must have .*broadcast, got state \(2,\).*{name} \(3,\)')
            for name in ('Kp', 'Kv', 'h')
        ),
        *(
            (name, 'much', rf'^{name} must be an array of real numbers, got much')
            for name in ('state', 'goal', 'Kp', 'Kv', 'h')
        ),
        ('state', np.zeros(2), r'^state must have shape \(\.\.\., 3\), got \(2,\)$'),
        ('state', [[0.0, 0.0, np.nan]], r'^state must be finite, got nan'),
        ('goal', np.zeros(2), r'^goal must have shape \(\.\.\., 3\), got \(2,\)$'),
        ('goal', [0.0, 0.0, np.inf], r'^goal must be finite, got .*inf'),
        ('goal', np.zeros((3, 3)), r'^state and goal .*broadcast, got state \(2,\), goal \(3,\)'),
    ],
)
def test_invalid_arguments_are_named(name, bad, message):
    with pytest.raises(ValueError, match=message):
        go_to_pose(**{**GOOD, name: bad})


# --- The node


@pytest.mark.parametrize('use_goal_heading', [False, True])
def test_each_odometry_is_answered_by_the_law_and_the_heading_is_always_taken(
    lockstep, use_goal_heading
):
    controller = Controller(
        lockstep, controller='pose', use_goal_heading=use_goal_heading, kp=4.0, yaw_goal_tolerance=0.1
    )
    controller.send(goals(goal(1.0, 0.0, 2.0), goal(2.0, -1.0, -1.5)))
    for pose in [(0.0, 0.0, 0.0), (2.0, -1.0, math.pi), (-3.0, 1.0, -2.0)]:
        assert controller.at(*pose) == pytest.approx(
            go_to_pose(pose, [1.0, 0.0, 2.0], 4.0, 0.5), rel=1e-9
        )
    # A waypoint on the way counts by its position; its heading bends the way there.
    assert controller.at(1.0, 0.01, 0.3) == pytest.approx(
        go_to_pose([1.0, 0.01, 0.3], [2.0, -1.0, -1.5], 4.0, 0.5)
    )
    assert controller.node.waypoint == 1
    assert controller.at(2.0, -0.99, -1.3) == pytest.approx(turn_in_place(-1.3, -1.5, 4.0))
    assert controller.at(2.0, -0.99, -1.41) == (0.0, 0.0)
    assert controller.statuses == [(0, ACCEPTED), (0, EXECUTING), (0, SUCCEEDED)]


@pytest.mark.parametrize('heading', [0.0, -2.5, math.pi])
@pytest.mark.parametrize('start', STARTS, ids=str)
@pytest.mark.parametrize('wheels', [False, True], ids=['twist', 'wheels'])
def test_poses_are_taken_also_from_behind_as_the_pure_functions_take_them(
    lockstep, wheels, start, heading
):
    topics, target = Topics(lockstep), (0.4, 0.3, heading)
    gains = {'controller': 'pose', 'kp': 12.0, 'kv': 4.0}
    if wheels:
        add_team(lockstep, pose=start, **gains)
    else:
        x, y, theta = start
        lockstep.add(make(VirtualRobot, x=x, y=y, theta=theta))
        lockstep.add(make(GoToGoal, **gains))
    topics.odom.clear()
    lockstep.publish('goal_pose', goal(*target))
    arrives(lockstep, topics)
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
    x, y, theta = pose_of(topics.odom[-1])
    assert math.dist((x, y), target[:2]) <= 0.02
    assert abs(se2.wrap_angle(theta - heading)) <= 0.02
    here, way = np.array(start), Waypoints(np.array([target]))
    for odometry in topics.odom[: len(topics.commands)]:
        np.testing.assert_allclose(differences(here, pose_of(odometry)), 0.0, atol=1e-9)
        way, command = way.follow(
            here, lambda pose, to: go_to_pose(pose, to, 12.0, 4.0), Arrival(use_heading=True), 12.0
        )
        here = here if command is None else se2.integrate(here, command, 0.02)
    assert command is None


def test_waypoints_with_headings_are_passed_in_order_and_the_last_heading_is_taken(lockstep):
    topics = Topics(lockstep)
    add_team(lockstep, controller='pose', kp=12.0, kv=4.0)
    way = [(0.4, 0.0, 0.5), (0.4, 0.4, math.pi), (0.0, 0.0, -1.0)]
    topics.odom.clear()
    lockstep.publish('goals', goals(*[goal(*one) for one in way]))
    arrives(lockstep, topics)
    poses = iter([pose_of(one) for one in topics.odom])
    for *position, heading in way:
        # The law alone, no turn in place, has the heading there but for little.
        passed = next(pose for pose in poses if math.dist(pose[:2], position) <= 0.02)
        assert abs(se2.wrap_angle(passed[2] - heading)) < 0.5
    assert abs(se2.wrap_angle(pose_of(topics.odom[-1])[2] + 1.0)) <= 0.02
    assert topics.statuses == [ACCEPTED, EXECUTING, SUCCEEDED]
