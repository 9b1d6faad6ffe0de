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

"""Rigid motions of the plane, SE(2).

Model: a pose `[x, y, theta]` (m, m, rad) is the placement of a frame B in a frame W, x forward,
y left, theta counter-clockwise and wrapped to (-pi, pi]. A twist `[vx, vy, omega]` (m/s, m/s,
rad/s) is a velocity in B.

Everything broadcasts over leading axes: a pose has shape (..., 3). Wrong shapes, values that are not
finite, and results that overflow raise ValueError, in single and in batched calls.

Source: doc/mathematics.md, "Motion"; document B for the homogeneous transform.
"""

from __future__ import annotations

from diffdrive_jacobian.numerics.elementary import cos, sin, sinc_defect, wrap
from diffdrive_jacobian.numerics.elementary import sinc as sin_ratio
from diffdrive_jacobian.numerics.formula import Entries, Number, Rows, Scalar, Vector, formula

__all__ = [
    'adjoint',
    'compose',
    'exp',
    'homogeneous',
    'homogeneous_3d',
    'integrate',
    'inverse',
    'left_jacobian',
    'log',
    'right_jacobian',
    'sinc',
    'wrap_angle',
]


@formula('() -> ()')
def wrap_angle(angle: Number) -> Scalar:
    """Wrap angles to (-pi, pi].

    Angles have any shape (rad). The result is exact with respect to the double nearest to 2 pi. An angle
    in the interval is returned unchanged.
    """
    return wrap(angle)


@formula('() -> ()')
def sinc(angle: Number) -> Scalar:
    """Compute sin(angle) / angle, which is 1 at zero (not NumPy's sin(pi x) / (pi x)).

    Angles have any shape (rad).
    """
    return sin_ratio(angle)


@formula('(3) -> (3)')
def exp(twist: Vector) -> Entries:
    """Return the pose after motion from the identity with a constant twist for unit time.

    `[V [vx, vy], a]` with the turn a and `V = [[sin(a)/a, (cos(a) - 1)/a], [(1 - cos(a))/a, sin(a)/a]]`,
    for twists `[vx, vy, omega]`, shape (..., 3): velocity in B times time (m, m, rad). The pose, shape
    (..., 3), has its theta wrapped.
    """
    vx, vy, turn = twist
    # sin(a)/a and (1 - cos(a))/a, of the half angle, so that small turns lose no digits.
    along = sin_ratio(turn / 2.0) * cos(turn / 2.0)
    across = sin_ratio(turn / 2.0) * sin(turn / 2.0)
    return [along * vx - across * vy, across * vx + along * vy, wrap(turn)]


@formula('(3) -> (3)')
def log(pose: Vector) -> Entries:
    """Return the twist that reaches a pose from the identity in unit time, the inverse of `exp`.

    For poses, shape (..., 3), it is `[vx, vy, omega]`, shape (..., 3), with the turn of least magnitude.
    """
    x, y, theta = pose
    half = wrap(theta) / 2.0
    along = cos(half) / sin_ratio(half)
    return [along * x + half * y, along * y - half * x, wrap(theta)]


@formula('(3),(3) -> (3)')
def compose(first: Vector, second: Vector) -> Entries:
    """Return the composition of two poses: `second`, given in the frame B of `first`, in the frame W.

    For poses of B in W, `first`, and of C in B, `second`, the result is the pose of C in W, each of
    shape (..., 3), theta wrapped.
    """
    x, y, theta = first
    dx, dy, turn = second
    return [
        x + cos(theta) * dx - sin(theta) * dy,
        y + sin(theta) * dx + cos(theta) * dy,
        wrap(theta + turn),
    ]


@formula('(3) -> (3)')
def inverse(pose: Vector) -> Entries:
    """Return the pose of W in B for the pose of B in W, shape (..., 3), theta wrapped."""
    x, y, theta = pose
    return [-cos(theta) * x - sin(theta) * y, sin(theta) * x - cos(theta) * y, wrap(-theta)]


@formula('(3) -> (3,3)')
def adjoint(pose: Vector) -> Rows:
    """Return the adjoint of a pose: it maps a twist in B to the same motion as a twist in W.

    `compose(pose, exp(twist)) = compose(exp(adjoint(pose) @ twist), pose)`. For poses of B in W, shape
    (..., 3), it has the shape (..., 3, 3), over `[vx, vy, omega]`.
    """
    x, y, theta = pose
    return [
        [cos(theta), -sin(theta), y],
        [sin(theta), cos(theta), -x],
        [0.0, 0.0, 1.0],
    ]


@formula('(3) -> (3,3)')
def left_jacobian(twist: Vector) -> Rows:
    """Return the left Jacobian of `exp`: `exp(t + d) = compose(exp(J d), exp(t))` to first order in d.

    For twists `[vx, vy, omega]`, shape (..., 3), velocity in B times time (m, m, rad), it has the shape
    (..., 3, 3).

    Source: Barfoot and Furgale, "Associating uncertainty with three-dimensional poses for use in
    estimation problems", 2014, for SE(3); here for SE(2).
    """
    vx, vy, turn = twist
    chord = sin_ratio(turn / 2.0)
    # sin(a)/a, (1 - cos(a))/a, (1 - cos(a))/a^2 and (a - sin(a))/a^2 of the turn a.
    along, across = chord * cos(turn / 2.0), chord * sin(turn / 2.0)
    bent, bowed = chord * chord / 2.0, turn * sinc_defect(turn)
    return [
        [along, -across, bowed * vx + bent * vy],
        [across, along, bowed * vy - bent * vx],
        [0.0, 0.0, 1.0],
    ]


@formula('(3) -> (3,3)')
def right_jacobian(twist: Vector) -> Rows:
    """Return the right Jacobian of `exp`: `exp(t + d) = compose(exp(t), exp(J d))` to first order in d.

    It is `left_jacobian` at the negative twist, which see.
    """
    vx, vy, turn = twist
    rows: Rows = left_jacobian.formula([-vx, -vy, -turn])
    return rows


@formula('(3) -> (3,3)')
def homogeneous(pose: Vector) -> Rows:
    """Return the homogeneous transform `H_B^W` of a pose (document B).

    For poses, shape (..., 3), it has the shape (..., 3, 3) and maps `[x, y, 1]` in B to W.
    """
    x, y, theta = pose
    return [
        [cos(theta), -sin(theta), x],
        [sin(theta), cos(theta), y],
        [0.0, 0.0, 1.0],
    ]


@formula('(3) -> (4,4)')
def homogeneous_3d(pose: Vector) -> Rows:
    """Return the homogeneous transform `H_B^W` of a pose in space, where z is up (document B).

    For poses, shape (..., 3), it has the shape (..., 4, 4) and maps `[x, y, z, 1]` in B to W.
    """
    x, y, theta = pose
    return [
        [cos(theta), -sin(theta), 0.0, x],
        [sin(theta), cos(theta), 0.0, y],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]


@formula('(3),(2),() -> (3)')
def integrate(pose: Vector, twist: Vector, dt: Number) -> Entries:
    """Return the pose after a constant twist of a unicycle, the exact arc `q * Exp(u dt)`.

    For poses at the start, shape (..., 3), twists `[v, omega]`, shape (..., 2) (m/s, rad/s), and
    durations dt, shape (...) (s), negative ones backward in time, the result has the shape (..., 3),
    theta wrapped. The chord `v dt sin(a/2)/(a/2)` along the heading `theta + a/2`, `a = omega dt`, loses
    no digits for small turns.

    Source: doc/mathematics.md, "Motion".
    """
    x, y, theta = pose
    v, omega = twist
    turn = omega * dt
    chord = v * dt * sin_ratio(turn / 2.0)
    heading = theta + turn / 2.0
    return [x + chord * cos(heading), y + chord * sin(heading), wrap(theta + turn)]
