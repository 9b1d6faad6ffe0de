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

"""A wheel as a contact: position and velocity of a point of its rim.

State: `q = [x, phi]`, the position of the wheel's centre (m) and the angle by which the wheel has turned
(rad). The wheel, of radius r, stands upright on the ground at height 0, so its centre is at height r.

A wheel that rolls does not slip: the point that touches the ground, at phi = pi, has no velocity. So
the rolling condition is the null space of the contact's Jacobian there: `x_dot = r phi_dot`.

Everything broadcasts over leading axes. A radius that is not positive and finite, other values that
are not finite, and shapes that do not broadcast raise ValueError.

Source: document C, "Kinematic structure of mobile robots"; doc/mathematics.md, "Differential drive".
"""

from __future__ import annotations

from math import pi

from diffdrive_jacobian.numerics.checks import positive
from diffdrive_jacobian.numerics.elementary import cos, sin
from diffdrive_jacobian.numerics.formula import Entries, Number, Rows, formula

__all__ = ['rolling_direction', 'wheel_contact_jacobian', 'wheel_contact_position']

AT_GROUND = pi
"""The angle phi of the point that touches the ground (rad)."""


@formula('(),(),() -> (3)', r=positive)
def wheel_contact_position(x: Number, phi: Number, r: Number) -> Entries:
    """Return the position of a point of the rim: `[x + r sin(phi), r + r cos(phi), 0]` (C).

    For positions x of the centre (m), angles phi of the point, 0 on top (rad), and r (m), each of shape
    (...), the result is `[along, up, sideways]`, shape (..., 3) (m).
    """
    return [x + r * sin(phi), r + r * cos(phi), 0.0]


@formula('(),() -> (3,2)', r=positive)
def wheel_contact_jacobian(phi: Number, r: Number) -> Rows:
    """Map `[x_dot, phi_dot]` to the velocity of the point: `[[1, r cos], [0, -r sin], [0, 0]]` (C).

    For angles phi of the point, 0 on top (rad), and r (m), shape (...), it has the shape (..., 3, 2). At
    phi = pi its null space is the rolling condition.
    """
    return [
        [1.0, r * cos(phi)],
        [0.0, -r * sin(phi)],
        [0.0, 0.0],
    ]


@formula('() -> (2)', r=positive)
def rolling_direction(r: Number) -> Entries:
    """Return the velocity of a rolling wheel: `[r, 1]` spans the null space at the ground (C).

    For r (m), shape (...), it is `[x_dot, phi_dot]` for one radian per second, shape (..., 2) (m/s,
    rad/s).
    """
    return [r, 1.0]
