"""What one writes without the library: formulas of one robot in floats or small arrays."""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, cos, hypot, pi, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap(angle: float) -> float:
    return angle if -pi < angle <= pi else (angle + pi) % (2.0 * pi) - pi


# --- Differential drive


def unicycle(theta: float) -> Array:
    return np.array([[cos(theta), 0.0], [sin(theta), 0.0], [0.0, 1.0]])


def wheel_to_body(r: float, L: float) -> Array:
    return np.array([[r / 2.0, r / 2.0], [r / L, -r / L]])


def body_to_wheel(r: float, L: float) -> Array:
    return np.array([[1.0 / r, L / (2.0 * r)], [1.0 / r, -L / (2.0 * r)]])


def wheel_to_world(theta: float, r: float, L: float) -> Array:
    x, y, turn = r / 2.0 * cos(theta), r / 2.0 * sin(theta), r / L
    return np.array([[x, x], [y, y], [turn, -turn]])


def single_wheel(theta: float, r: float) -> Array:
    return np.array([[r * cos(theta), 0.0], [r * sin(theta), 0.0], [0.0, 1.0]])


def wheel_to_position(theta: float, r: float, L: float) -> Array:
    x, y = r / 2.0 * cos(theta), r / 2.0 * sin(theta)
    return np.array([[x, x], [y, y]])


def point(pose: tuple[float, ...], d: float) -> Array:
    x, y, theta = pose
    return np.array([x + d * cos(theta), y + d * sin(theta)])


def point_jacobian(theta: float, r: float, L: float, d: float) -> Array:
    c, s, along, across = cos(theta), sin(theta), r / 2.0, d * r / L
    return np.array(
        [
            [c * along - s * across, c * along + s * across],
            [s * along + c * across, s * along - c * across],
        ]
    )


def wheel_speeds(v: float, omega: float, r: float, L: float) -> tuple[float, float]:
    return (v + omega * L / 2.0) / r, (v - omega * L / 2.0) / r


def body_twist(omega_R: float, omega_L: float, r: float, L: float) -> tuple[float, float]:
    return r * (omega_R + omega_L) / 2.0, r * (omega_R - omega_L) / L


def no_lateral_slip(theta: float) -> Array:
    return np.array([[sin(theta), -cos(theta), 0.0]])


def bracket(theta: float) -> Array:
    return np.array([sin(theta), -cos(theta), 0.0])


def controllability(theta: float) -> Array:
    c, s = cos(theta), sin(theta)
    return np.array([[c, 0.0, s], [s, 0.0, -c], [0.0, 1.0, 0.0]])


def rolling(theta: float, r: float, L: float) -> tuple[Array, Array]:
    c, s = cos(theta), sin(theta)
    return (
        np.array([[s, -c, 0.0], [c, s, L / 2.0], [c, s, -L / 2.0]]),
        np.array([[0.0, 0.0], [r, 0.0], [0.0, r]]),
    )


def contact_position(x: float, phi: float, r: float) -> Array:
    return np.array([x + r * sin(phi), r + r * cos(phi), 0.0])


def contact_jacobian(phi: float, r: float) -> Array:
    return np.array([[1.0, r * cos(phi)], [0.0, -r * sin(phi)], [0.0, 0.0]])


def rolling_direction(r: float) -> Array:
    return np.array([r, 1.0])


# --- Inverse velocities


def damping(w: float, w_0: float, most: float) -> Array:
    return np.asarray(most * max(1.0 - w / w_0, 0.0))


def damped(J: Array, x_dot: Array, factor: float) -> Array:
    return J.T @ np.linalg.solve(J @ J.T + factor * factor * np.eye(len(J)), x_dot)


def projector(J: Array) -> Array:
    return np.eye(J.shape[1]) - np.linalg.pinv(J) @ J


def redundant(J: Array, x_dot: Array, q_dot_0: Array) -> Array:
    inverse = np.linalg.pinv(J)
    return inverse @ x_dot + q_dot_0 - inverse @ (J @ q_dot_0)


def manipulability(J: Array) -> Any:
    return np.sqrt(np.linalg.det(J @ J.T))


def gradient(function: Callable[[Array], Any], q: Array) -> Array:
    found = np.empty_like(q)
    for i in range(len(q)):
        step = np.zeros_like(q)
        step[i] = 6e-6
        found[i] = (function(q + step) - function(q - step)) / 1.2e-5
    return found


def limit_cost(q: Array, lower: Array, upper: Array) -> Any:
    return np.mean(((q - (lower + upper) / 2.0) / (upper - lower)) ** 2) / 2.0


def limit_gradient(q: Array, lower: Array, upper: Array) -> Array:
    return (q - (lower + upper) / 2.0) / ((upper - lower) ** 2 * len(q))


def prioritized(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    (J_1, x_1), (J_2, x_2) = first, second
    inverse = np.linalg.pinv(J_1)
    q_dot = inverse @ x_1
    N = np.eye(J_1.shape[1]) - inverse @ J_1
    return q_dot + N @ np.linalg.pinv(J_2 @ N) @ (x_2 - J_2 @ q_dot)


def limited(q_dot: Array, most: float) -> Array:
    return q_dot / max(1.0, np.abs(q_dot).max() / most)


# --- Arms


def positions(lengths: Array, q: Array) -> Array:
    angles = np.cumsum(q)
    links = np.stack([lengths * np.cos(angles), lengths * np.sin(angles)], axis=-1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(links, axis=0)])


def clearance(lengths: Array, q: Array, obstacle: Array) -> float:
    joints = positions(lengths, q)
    links, to_obstacle = np.diff(joints, axis=0), obstacle - joints[:-1]
    part = np.clip((to_obstacle * links).sum(axis=-1) / lengths**2, 0.0, 1.0)
    return float(np.linalg.norm(to_obstacle - part[:, np.newaxis] * links, axis=-1).min())


def tip(lengths: Array, q: Array) -> Array:
    angles = np.cumsum(q)
    return np.array([lengths @ np.cos(angles), lengths @ np.sin(angles), wrap(angles[-1])])


def two_links(lengths: Array, q: Array) -> Array:
    """As document A writes it."""
    (l_1, l_2), (q_1, q_2) = lengths.tolist(), q.tolist()
    s_1, s_12, c_1, c_12 = sin(q_1), sin(q_1 + q_2), cos(q_1), cos(q_1 + q_2)
    return np.array([[-l_1 * s_1 - l_2 * s_12, -l_2 * s_12], [l_1 * c_1 + l_2 * c_12, l_2 * c_12]])


def arm_jacobian(lengths: Array, q: Array) -> Array:
    angles = np.cumsum(q)
    x = np.cumsum((lengths * np.cos(angles))[::-1])[::-1]
    y = np.cumsum((lengths * np.sin(angles))[::-1])[::-1]
    return np.stack([-y, x])


def determinant(lengths: Array, q: Array) -> Any:
    return lengths[0] * lengths[1] * np.sin(q[1])


def singular(q_1: float) -> Array:
    return np.array([[q_1, 0.0], [q_1, pi]])


def mobile_tip(lengths: Array, q: Array) -> Array:
    x, y, heading = tip(lengths, q[3:])
    c, s = cos(q[2]), sin(q[2])
    return np.array([q[0] + c * x - s * y, q[1] + s * x + c * y, wrap(q[2] + heading)])


def mobile_jacobian(lengths: Array, r: float, L: float, q: Array) -> Array:
    c, s = cos(q[2]), sin(q[2])
    arm = two_links(lengths, q[3:])
    base = np.array([[1.0, arm[0, 0]], [0.0, arm[1, 0]]]) @ wheel_to_body(r, L)
    return np.array([[c, -s], [s, c]]) @ np.hstack([base, arm])


def configuration_jacobian(r: float, L: float, q: Array) -> Array:
    G = np.zeros((5, 4))
    G[:3, :2] = wheel_to_world(q[2], r, L)
    G[3:, 2:] = np.eye(2)
    return G


def mobile_integrate(r: float, L: float, q: Array, q_dot: Array, dt: float) -> Array:
    x, y, theta, *joints = q.tolist()
    right, left, *speeds = q_dot.tolist()
    v, omega = body_twist(right, left, r, L)
    half = omega * dt / 2.0
    chord = v * dt * (sin(half) / half if half else 1.0)
    return np.array(
        [
            x + chord * cos(theta + half),
            y + chord * sin(theta + half),
            wrap(theta + 2.0 * half),
            *(a + b * dt for a, b in zip(joints, speeds, strict=True)),
        ]
    )


def pose_difference(target: Array, pose: Array) -> Array:
    error = target - pose
    error[2] = wrap(error[2])
    return error


def levenberg_marquardt(
    forward: Callable[[Array], Array], jacobian: Callable[[Array], Array], target: Array, q: Array
) -> Array:
    factor, e = 0.1, target - forward(q)
    for _ in range(100):
        J = jacobian(q)
        tried = q + np.linalg.solve(J.T @ J + factor * np.eye(len(q)), J.T @ e)
        e_tried = target - forward(tried)
        if np.linalg.norm(e_tried) < np.linalg.norm(e):
            q, e, factor = tried, e_tried, factor / 10.0
        else:
            factor *= 4.0
        if np.linalg.norm(e) < 1e-6:
            break
    return q


# --- Control


def go_to_goal(state: Any, goal: Any, Kp: float, Kv: float) -> tuple[float, float]:
    x, y, theta = state
    dx, dy = goal[0] - x, goal[1] - y
    error = wrap(atan2(dy, dx) - theta)
    return Kv * hypot(dx, dy) * cos(error), Kp * error


def offset_point(state: Any, goal: Any, k: float, d: float) -> tuple[float, float]:
    x, y, theta = state
    c, s = cos(theta), sin(theta)
    dx, dy = goal[0] - x - d * c, goal[1] - y - d * s
    return k * (c * dx + s * dy), k * (c * dy - s * dx) / d


def go_to_pose(state: Any, goal: Any, Kp: float, Kv: float, h: float) -> tuple[float, float]:
    x, y, theta = state
    x_goal, y_goal, heading = goal
    dx, dy = x_goal - x, y_goal - y
    bearing = atan2(dy, dx)
    alpha, phi = wrap(bearing - theta), wrap(bearing - heading)
    bend = cos(alpha) * (sin(alpha) / alpha if alpha else 1.0)
    return Kv * hypot(dx, dy) * cos(alpha), Kp * alpha + Kv * bend * (alpha + h * phi)


def turn_in_place(theta: float, heading: float, Kp: float) -> tuple[float, float]:
    return 0.0, Kp * wrap(heading - theta)


def saturate(
    v: float, omega: float, limits: tuple[float, ...], r: float, L: float
) -> tuple[float, float]:
    min_v, max_v, min_omega, max_omega, fastest = limits
    wheel = (abs(v) + abs(omega) * L / 2.0) / r
    k = max(1.0, v / max_v, v / min_v, omega / max_omega, omega / min_omega, wheel / fastest)
    return v / k, omega / k


def distance(x: float, y: float, x_goal: float, y_goal: float) -> float:
    return hypot(x_goal - x, y_goal - y)


def faces(theta: float, heading: float) -> bool:
    return abs(wrap(heading - theta)) <= 0.02


def follow(poses: Array, index: int, state: Any) -> tuple[float, float]:
    goal = poses[index].tolist()
    while hypot(goal[0] - state[0], goal[1] - state[1]) <= 0.02:
        index += 1
        goal = poses[index].tolist()
    return go_to_goal(state, goal, 3.0, 0.5)


def resolved_rate(J: Array, x: Array, x_d: Array, x_dot: Array, gain: float, factor: float) -> Array:
    return damped(J, x_dot + gain * (x_d - x), factor)


def line_position(start: Array, end: Array, speed: float, t: float) -> Array:
    part = min(max(t * speed / np.linalg.norm(end - start), 0.0), 1.0)
    return start + part * (end - start)
