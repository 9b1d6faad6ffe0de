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

"""Velocities of the points of a rigid body.

A body moves with the angular velocity `omega` (rad/s) while its point P has the velocity `v` (m/s). Any
other point Q of it then has the velocity `v + omega × PQ`. A wheel that rolls and an axle that turns are
such bodies, so document E derives the differential drive with this equation alone.

All vectors are in the same frame. Everything broadcasts over leading axes. Wrong shapes, values that are
not finite, and results that overflow raise ValueError.

Source: document E, `v_C = v_P + omega × PC` and `v_C2 = v_C1 + theta_dot k × C1C2`.
"""

from __future__ import annotations

from diffdrive_jacobian.numerics.formula import Entries, Vector, formula

__all__ = ['point_velocity']


@formula('(3),(3),(3) -> (3)')
def point_velocity(v: Vector, omega: Vector, offset: Vector) -> Entries:
    """Return the velocity of a point Q of a rigid body: `v_Q = v_P + omega × PQ` (E).

    For velocities v of the point P (m/s), angular velocities omega of the body (rad/s), and vectors from
    P to Q, `offset` (m), each of shape (..., 3), the result has the shape (..., 3) (m/s).
    """
    v_x, v_y, v_z = v
    omega_x, omega_y, omega_z = omega
    x, y, z = offset
    return [
        v_x + omega_y * z - omega_z * y,
        v_y + omega_z * x - omega_x * z,
        v_z + omega_x * y - omega_y * x,
    ]
