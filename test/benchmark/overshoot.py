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

"""Overshoot and time to the goal of each built-in controller, for a robot that takes time to follow.

Default gains, starts 2 m from the goal, with headings in all directions, at 50 Hz. The robot has the
velocity limits of the TurtleBot3 Burger, the accelerations with which ROBOTIS plans its paths,
then a lag and a delay too, and then a slow acceleration.

    python test/benchmark/overshoot.py     the table of doc/controllers.md; --quick: 12 starts, to try it
"""

from __future__ import annotations

import argparse

import numpy as np

from diffdrive_jacobian.control import Arrival, VelocityLimits
from diffdrive_jacobian.control.controllers import CONTROLLERS
from diffdrive_jacobian.simulation import (
    AccelerationLimits,
    Actuators,
    AxisLimits,
    SweepSetup,
    closed_loops,
)

STARTS = 120
LIMITS = VelocityLimits(min_v=-0.22, max_v=0.22, min_omega=-2.84, max_omega=2.84)
OMEGA = AxisLimits(
    max_acceleration=3.2,
    max_deceleration=-3.2,
    max_acceleration_reverse=-3.2,
    max_deceleration_reverse=3.2,
)


def v_limits(a: float) -> AxisLimits:
    """Return limits of the acceleration of v that are all alike (m/s^2)."""
    return AxisLimits(
        max_acceleration=a,
        max_deceleration=-a,
        max_acceleration_reverse=-a,
        max_deceleration_reverse=a,
    )


PLANNED = AccelerationLimits(v=v_limits(2.5), omega=OMEGA)
ROBOTS = {
    'follows at once': Actuators(),
    '2.5 m/s², 3.2 rad/s²': Actuators(acceleration=PLANNED),
    'the same, lag 0.1 s, delay 0.1 s': Actuators(acceleration=PLANNED, lag=0.1, delay=100_000_000),
    '0.05 m/s², 3.2 rad/s²': Actuators(acceleration=AccelerationLimits(v=v_limits(0.05), omega=OMEGA)),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description='Overshoot of the built-in controllers.')
    parser.add_argument('--quick', action='store_true', help='few starts, to try it')
    count = 12 if parser.parse_args().quick else STARTS
    print('| controller | robot | arrived | time, mean, max | overshoot, max | rest, max |')
    print('|---|---|---:|---:|---:|---:|')
    for name, controller in CONTROLLERS.built_in.items():
        starts = SweepSetup(controller=name, starts=count).poses()
        arrival = Arrival(
            use_heading=controller.takes_heading, offset=controller.driven_offset(controller.defaults)
        )
        goal = np.zeros(3 if controller.takes_heading else 2)
        for robot, actuators in ROBOTS.items():
            found = closed_loops(
                controller,
                starts,
                goal,
                *controller.values(controller.defaults),
                arrival=arrival,
                limits=LIMITS,
                actuators=actuators,
            )
            x, y, theta = found.pose.T
            rest = arrival.distance(x, y, theta, 0.0, 0.0)
            print(
                f'| {name} | {robot} | {np.mean(found.arrived):.0%} | {np.nanmean(found.time):.1f} s, '
                f'{np.nanmax(found.time):.1f} s | {1000.0 * found.overshoot.max():.0f} mm '
                f'| {1000.0 * rest.max():.0f} mm |'
            )


if __name__ == '__main__':
    main()
