"""The go-to-goal law of document A, equations (9)-(11), and the loop it closes at 50 Hz."""

from __future__ import annotations

import math

import numpy as np
import pytest

from diffdrive_jacobian.control import go_to_goal, go_to_pose, offset_point, turn_in_place
from diffdrive_jacobian.kinematics.diff_drive import unicycle_jacobian
from diffdrive_jacobian.kinematics.se2 import integrate

KP, KV = 3.0, 0.5  # document A's gains
RATE = 50.0


def random_states(seed, count=10_000):
    """States all around, goals near and far, gains from sluggish to wild (kp below kv included)."""
    rng = np.random.default_rng(seed)
    states = rng.uniform([-5.0, -5.0, -np.pi], [5.0, 5.0, np.pi], (count, 3))
    way, bearing = 10.0 ** rng.uniform(-6.0, 1.0, count), rng.uniform(-np.pi, np.pi, count)
    goals = states[:, :2] + way[:, np.newaxis] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    Kp, Kv = 10.0 ** rng.uniform(-2.0, 2.0, (2, count))
    return states, goals, Kp, Kv


def offsets(states, goals):
    """Give the vector to the goal and its length."""
    to_goal = goals - states[..., :2]
    return to_goal, np.hypot(to_goal[..., 0], to_goal[..., 1])


def document_a(state, goal, Kp, Kv):
    """Equations (9)-(11) as document A's script computes them."""
    (x, y, theta), (x_goal, y_goal) = state, goal
    d = math.sqrt((x_goal - x) ** 2 + (y_goal - y) ** 2)
    error = math.atan2(y_goal - y, x_goal - x) - theta
    error = math.atan2(math.sin(error), math.cos(error))
    return Kv * d * math.cos(error), Kp * error


def distance_rate(states, goals, v, omega):
    """d_dot of a robot that moves by `q_dot = S(theta) u`."""
    q_dot = (unicycle_jacobian(states[..., 2]) @ np.stack([v, omega], -1)[..., np.newaxis])[..., 0]
    to_goal, distance = offsets(states, goals)
    return -np.sum(to_goal * q_dot[..., :2], axis=-1) / distance


# --- The law


def test_the_law_is_document_as_broadcast_over_states_goals_and_gains():
    states, goals, Kp, Kv = random_states(1)
    v, omega = go_to_goal(states, goals, Kp, Kv)
    expected = [document_a(*one) for one in zip(states, goals, Kp, Kv, strict=True)]
    np.testing.assert_allclose(np.column_stack([v, omega]), expected, rtol=1e-12, atol=1e-12)
    # Leading axes of every operand, against each other.
    grid = go_to_goal(states[:3, np.newaxis], goals[:4], Kp[:3, np.newaxis], Kv[:4])
    for i, j in np.ndindex(3, 4):
        one = go_to_goal(states[i], goals[j], Kp[i], Kv[j])
        np.testing.assert_allclose([grid[0][i, j], grid[1][i, j]], one, rtol=1e-13)


def test_the_distance_never_grows():
    states, goals, Kp, Kv = random_states(2)
    v, omega = go_to_goal(states, goals, Kp, Kv)
    d_dot = distance_rate(states, goals, v, omega)
    to_goal, distance = offsets(states, goals)
    heading = unicycle_jacobian(states[:, 2])[:, :2, 0]
    cos_error = np.sum(to_goal * heading, axis=-1) / distance
    rounding = 1e-14 * Kv * distance
    assert np.all(d_dot <= rounding * np.abs(cos_error))
    assert np.all(np.abs(d_dot + Kv * distance * cos_error**2) <= rounding)


@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_abeam_of_the_goal_the_robot_only_turns(side):
    v, omega = go_to_goal([1.0, 2.0, 0.0], [1.0, 2.0 + side], KP, KV)
    assert abs(v) < 1e-16
    assert omega == side * KP * math.pi / 2.0


def test_on_the_goal_it_stands_still_whatever_the_heading():
    states = random_states(3, 100)[0]
    v, omega = go_to_goal(states, states[:, :2], KP, KV)
    assert not v.any()
    assert not omega.any()


def test_the_error_is_wrapped_across_the_cut():
    """The goal at 179 deg, the robot looking to -179 deg: 2 deg to the right, and the mirror image."""
    one = math.radians(1.0)
    for side in (1.0, -1.0):
        goal = 2.0 * np.array([math.cos(math.pi - one), side * math.sin(math.pi - one)])
        v, omega = go_to_goal([0.0, 0.0, side * (one - math.pi)], goal, KP, KV)
        assert omega == pytest.approx(-side * KP * 2.0 * one, rel=1e-12)
        assert v == pytest.approx(KV * 2.0 * math.cos(2.0 * one), rel=1e-12)


@pytest.mark.parametrize('ratio', [0.3, 0.7, 0.99])
def test_with_kp_below_kv_the_heading_error_has_a_fixed_point_off_zero(ratio):
    """`e_dot = Kv sin(e) cos(e) - Kp e` vanishes where sin(2e) / (2e) = Kp / Kv (doc/mathematics.md)."""
    low, high = 1e-3, math.pi / 2.0
    for _ in range(100):
        error = (low + high) / 2.0
        low, high = (error, high) if math.sin(2.0 * error) > 2.0 * error * ratio else (low, error)
    step = 1e-5
    before = np.array([0.0, 0.0, -error])
    after = integrate(before, go_to_goal(before, [1.0, 0.0], ratio, 1.0), step)
    bearing = math.atan2(-after[1], 1.0 - after[0])
    # The error stays at first order, while the robot turns.
    assert abs(bearing - after[2] - error) < 10.0 * step**2
    assert after[2] - before[2] > 0.1 * step * ratio


@pytest.mark.parametrize(
    ('state', 'goal', 'name'), [([0.0] * 2, [1.0] * 2, 'state'), ([0.0] * 3, [1.0] * 3, 'goal')]
)
def test_a_wrong_shape_is_named(state, goal, name):
    with pytest.raises(ValueError, match=rf'^{name} must have shape'):
        go_to_goal(state, goal, KP, KV)


# --- The sampled loop


def test_the_sampled_loop_arrives_from_every_start():
    here, goals, _, _ = random_states(4, 2_000)
    # The farthest goal, 10 m away, comes near like exp(-kv t); the 3 s on top are for the first turn.
    for _ in range(int(RATE * (math.log(10.0 / 0.02) / KV + 3.0))):
        here = integrate(here, np.stack(go_to_goal(here, goals, KP, KV), -1), 1.0 / RATE)
    assert np.all(offsets(here, goals)[1] <= 0.02)


def test_turning_in_place_takes_the_smaller_angle_and_ends_at_the_heading():
    rng = np.random.default_rng(5)
    here = start = rng.uniform(-np.pi, np.pi, (2_000, 3))
    heading, turned = rng.uniform(-np.pi, np.pi, 2_000), np.zeros(2_000)
    for _ in range(500):
        v, omega = turn_in_place(here[:, 2], heading, KP)
        here = integrate(here, np.stack([v, omega], -1), 1.0 / RATE)
        turned += np.abs(omega) / RATE
    assert np.array_equal(here[:, :2], start[:, :2])
    assert np.abs(np.sin((here[:, 2] - heading) / 2.0)).max() < 1e-12
    short_way = np.arccos(np.cos(heading - start[:, 2]))
    np.testing.assert_allclose(turned, short_way, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize('law', [go_to_goal, go_to_pose, offset_point])
@pytest.mark.parametrize('name', ['state', 'goal'])
@pytest.mark.parametrize('size', [1, 4])
def test_a_tuple_of_another_length_is_named(law, name, size):
    arguments = {'state': (0.0, 0.0, 0.0), 'goal': (1.0, 1.0, 0.0)[: 3 if law is go_to_pose else 2]}
    with pytest.raises(ValueError, match=f'^{name} must have shape'):
        law(*(arguments | {name: (0.5,) * size}).values(), 1.0, 0.5)
