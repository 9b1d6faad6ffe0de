"""Single calls of kinematics and control: microseconds per call, beside the same formula by hand.

By hand means what one writes without the library: the formula in floats or small NumPy arrays, without
any check of its arguments (by_hand.py). Both sides give the same, which is looked at first. CPU time of
the process counts, so that other processes disturb little.

As a program it prints for every function the least figures of all rounds: `single_calls.py [NAME ...]`.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import by_hand
import numpy as np
from table import Goal, Row, interleave

from diffdrive_jacobian import control
from diffdrive_jacobian.control import Arrival, StraightLine, VelocityLimits, Waypoints
from diffdrive_jacobian.kinematics import contact, diff_drive
from diffdrive_jacobian.kinematics import inverse_kinematics as ik
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

MOST = 3.0
"""Times as long as by hand that a single call may take."""
SOLVER = 'inverse_kinematics.solve'
"""The one call that takes long, and whose results agree up to its tolerance only."""

WHEELS, THETA, D = (0.033, 0.16), 0.5, 0.1
POSE, GOAL, GOAL_POSE = (0.3, -0.2, 1.0), (1.0, 2.0), (1.0, 2.0, -1.0)
LIMITS = (-0.22, 0.22, -2.84, 2.84, 6.67)
ARM, LONG_ARM = PlanarArm([1.0, 0.7]), PlanarArm(np.linspace(0.5, 0.2, 7))
ROBOT = MobileManipulator(*WHEELS, ARM)
Q, LONG_Q = np.array([0.5, 0.9]), np.linspace(0.1, 0.7, 7)
WHOLE_Q, WHOLE_SPEEDS = np.array([0.1, 0.2, 0.3, 0.5, 0.9]), np.array([3.0, 2.0, 0.1, 0.2])
J, WIDE, X_DOT = ARM.jacobian(Q), LONG_ARM.jacobian(LONG_Q), np.array([0.1, -0.2])
LOWER, UPPER = np.full(2, -3.0), np.full(2, 2.0)
START, END = np.zeros(2), np.array([1.0, 0.5])
TARGET, HERE = np.array([0.9, 0.8, 3.0]), np.array([0.1, 0.2, -3.0])


class Call(NamedTuple):
    """A public function, and what one writes instead."""

    name: str
    ours: Callable[[], Any]
    by_hand: Callable[[], Any]

    def check(self) -> None:
        """Refuse to compare speeds of ways to different results."""
        ours, other = self.ours(), self.by_hand()
        tolerance = 1e-5 if self.name in (SOLVER, 'inverse_velocity.manipulability_gradient') else 1e-9
        for mine, theirs in zip(_parts(ours), _parts(other), strict=True):
            if not np.allclose(mine, theirs, rtol=tolerance, atol=tolerance):
                raise RuntimeError(f'{self.name}: different results, {ours} and {other}')

    def microseconds(self, side: str, number: int) -> float:
        """Return the CPU time of one call."""
        function: Callable[[], Any] = getattr(self, side)
        begun = time.process_time()
        for _ in range(number):
            function()
        return (time.process_time() - begun) / number * 1e6


def _name(function: Callable[..., Any]) -> str:
    name = function.__qualname__
    return f'{function.__module__.rpartition(".")[2]}.{name}' if '.' not in name else name


def _parts(result: Any) -> Any:
    return result if isinstance(result, tuple) else (result,)


def _law(pose: Any, goal: Any) -> tuple[float, float]:
    return control.go_to_goal(pose, goal[:2], 3.0, 0.5)


class _Gains:
    kp, kv, offset = 3.0, 0.5, 0.1


def _one_step() -> tuple[float, float]:
    """What the node does for every odometry message: law, arrival, saturation."""
    v, omega = control.go_to_goal(POSE, GOAL, 3.0, 0.5)
    ARRIVAL.distance(*POSE, *GOAL)
    return control.saturate(v, omega, VELOCITY_LIMITS, *WHEELS)


def _one_step_by_hand() -> tuple[float, float]:
    v, omega = by_hand.go_to_goal(POSE, GOAL, 3.0, 0.5)
    by_hand.distance(*POSE[:2], *GOAL)
    return by_hand.saturate(v, omega, LIMITS, *WHEELS)


def _tip(q: Any) -> Any:
    return ARM.forward_kinematics(q)[..., :2]


ARRIVAL = Arrival()
VELOCITY_LIMITS = VelocityLimits(
    **dict(zip(VelocityLimits.names(), LIMITS, strict=True)),
)
WAYPOINTS = Waypoints([[1.0, 0.0, 0.0], [1.0, 1.0, 2.0]])
LINE = StraightLine(START, END, 0.1)
BOUND = control.find_controller('go_to_goal').bind(_Gains())


def calls() -> list[Call]:
    """Return every comparison."""
    sides: list[tuple[Any, Any, tuple[Any, ...]]] = [
        (diff_drive.unicycle_jacobian, by_hand.unicycle, (THETA,)),
        (diff_drive.wheel_to_body_jacobian, by_hand.wheel_to_body, WHEELS),
        (diff_drive.body_to_wheel_jacobian, by_hand.body_to_wheel, WHEELS),
        (diff_drive.wheel_to_world_jacobian, by_hand.wheel_to_world, (THETA, *WHEELS)),
        (diff_drive.single_wheel_jacobian, by_hand.single_wheel, (THETA, WHEELS[0])),
        (diff_drive.wheel_to_position_jacobian, by_hand.wheel_to_position, (THETA, *WHEELS)),
        (diff_drive.offset_point, by_hand.point, (POSE, D)),
        (diff_drive.offset_point_jacobian, by_hand.point_jacobian, (THETA, *WHEELS, D)),
        (diff_drive.body_to_wheel, by_hand.wheel_speeds, (0.2, 0.5, *WHEELS)),
        (diff_drive.wheel_to_body, by_hand.body_twist, (3.0, 5.0, *WHEELS)),
        (diff_drive.no_lateral_slip_constraint, by_hand.no_lateral_slip, (THETA,)),
        (diff_drive.rolling_constraints, by_hand.rolling, (THETA, *WHEELS)),
        (diff_drive.lie_bracket, by_hand.bracket, (THETA,)),
        (diff_drive.controllability_matrix, by_hand.controllability, (THETA,)),
        (contact.wheel_contact_position, by_hand.contact_position, (0.1, THETA, WHEELS[0])),
        (contact.wheel_contact_jacobian, by_hand.contact_jacobian, (THETA, WHEELS[0])),
        (contact.rolling_direction, by_hand.rolling_direction, (WHEELS[0],)),
        (iv.adjugate_inverse, np.linalg.inv, (J,)),
        (iv.pseudoinverse, np.linalg.pinv, (J,)),
        (iv.damping, by_hand.damping, (0.1, 0.2, 0.1)),
        (iv.damped_least_squares, by_hand.damped, (J, X_DOT, 0.1)),
        (iv.null_space_projector, by_hand.projector, (WIDE,)),
        (iv.redundant, by_hand.redundant, (WIDE, X_DOT, LONG_Q)),
        (iv.manipulability, by_hand.manipulability, (J,)),
        (iv.joint_limit_cost, by_hand.limit_cost, (Q, LOWER, UPPER)),
        (iv.joint_limit_gradient, by_hand.limit_gradient, (Q, LOWER, UPPER)),
        (iv.limit_velocity, by_hand.limited, (X_DOT, 0.15)),
        (ARM.joint_positions, partial(by_hand.positions, ARM.lengths), (Q,)),
        (ARM.forward_kinematics, partial(by_hand.tip, ARM.lengths), (Q,)),
        (ARM.jacobian, partial(by_hand.two_links, ARM.lengths), (Q,)),
        (ARM.determinant, partial(by_hand.determinant, ARM.lengths), (Q,)),
        (ARM.singular_configurations, by_hand.singular, (0.1,)),
        (ARM.clearance, partial(by_hand.clearance, ARM.lengths), (Q, END)),
        (ARM.integrate, lambda q, q_dot, dt: q + q_dot * dt, (Q, X_DOT, 0.1)),
        (ROBOT.forward_kinematics, partial(by_hand.mobile_tip, ARM.lengths), (WHOLE_Q,)),
        (ROBOT.jacobian, partial(by_hand.mobile_jacobian, ARM.lengths, *WHEELS), (WHOLE_Q,)),
        (ROBOT.configuration_jacobian, partial(by_hand.configuration_jacobian, *WHEELS), (WHOLE_Q,)),
        (ROBOT.integrate, partial(by_hand.mobile_integrate, *WHEELS), (WHOLE_Q, WHOLE_SPEEDS, 0.1)),
        (ik.pose_difference, by_hand.pose_difference, (TARGET, HERE)),
        (control.go_to_goal, by_hand.go_to_goal, (POSE, GOAL, 3.0, 0.5)),
        (control.offset_point, by_hand.offset_point, (POSE, GOAL, 0.5, D)),
        (control.go_to_pose, by_hand.go_to_pose, (POSE, GOAL_POSE, 3.0, 0.5, 9.0)),
        (control.turn_in_place, by_hand.turn_in_place, (0.5, 3.0, 3.0)),
        (ARRIVAL.faces, by_hand.faces, (0.5, 3.0)),
        (LINE.position, partial(by_hand.line_position, START, END, 0.1), (0.5,)),
    ]
    found = [
        Call(_name(ours), partial(ours, *arguments), partial(other, *arguments))
        for ours, other, arguments in sides
    ]
    # Those whose arguments differ from what one passes by hand.
    inside, beyond = (0.1, 0.2), (1.0, 2.0)
    pair, rate = [(WIDE, X_DOT), (WIDE[:1], X_DOT[:1])], (J, Q, X_DOT, X_DOT, 1.0, 0.1)
    law = partial(by_hand.go_to_goal, POSE, GOAL, 3.0, 0.5)
    found += [
        *(
            Call(
                f'saturation.saturate, {where} the limits',
                partial(control.saturate, *twist, VELOCITY_LIMITS, *WHEELS),
                partial(by_hand.saturate, *twist, LIMITS, *WHEELS),
            )
            for where, twist in (('within', inside), ('beyond', beyond))
        ),
        Call(
            'Arrival.distance',
            partial(ARRIVAL.distance, *POSE, *GOAL),
            partial(by_hand.distance, *POSE[:2], *GOAL),
        ),
        Call('law of find_controller', partial(BOUND, POSE, GOAL), law),
        Call(
            'Waypoints.follow',
            lambda: WAYPOINTS.follow(POSE, _law, ARRIVAL, 3.0)[1],
            partial(by_hand.follow, WAYPOINTS.poses, 0, POSE),
        ),
        Call('one step: law, arrival, saturation', _one_step, _one_step_by_hand),
        Call(
            'resolved_rate.resolved_rate',
            partial(control.resolved_rate, *rate),
            partial(by_hand.resolved_rate, *rate),
        ),
        Call(
            'inverse_velocity.prioritized',
            partial(iv.prioritized, pair[:1]),
            lambda: np.linalg.pinv(WIDE) @ X_DOT,
        ),
        Call(
            'inverse_velocity.manipulability_gradient',
            partial(iv.manipulability_gradient, ARM.jacobian, Q),
            lambda: by_hand.gradient(
                lambda q: by_hand.manipulability(by_hand.two_links(ARM.lengths, q)), Q
            ),
        ),
        Call(
            'PlanarArm.inverse_velocity',
            partial(ARM.inverse_velocity, Q, X_DOT),
            lambda: np.linalg.solve(by_hand.two_links(ARM.lengths, Q), X_DOT),
        ),
        Call(
            'PlanarArm.joint_torques',
            partial(ARM.joint_torques, Q, X_DOT),
            lambda: by_hand.two_links(ARM.lengths, Q).T @ X_DOT,
        ),
        Call(
            'PlanarArm.jacobian, 7 links',
            partial(LONG_ARM.jacobian, LONG_Q),
            partial(by_hand.arm_jacobian, LONG_ARM.lengths, LONG_Q),
        ),
        Call(
            SOLVER,
            lambda: ik.solve(_tip, ARM.jacobian, TARGET[:2], HERE[:2]).q,
            lambda: by_hand.levenberg_marquardt(
                lambda q: by_hand.tip(ARM.lengths, q)[:2],
                partial(by_hand.two_links, ARM.lengths),
                TARGET[:2],
                HERE[:2],
            ),
        ),
    ]
    return found


def measured(quick: bool, names: list[str] | None = None) -> dict[str, list[tuple[float, float]]]:
    """Measure both sides of each call in turn. Return microseconds of ours and by hand."""
    rounds, number = (5, 20) if quick else (60, 200)
    found = {}
    gc.disable()
    for call in calls():
        if names and not any(name in call.name for name in names):
            continue
        call.check()
        count = max(number // 10, 2) if call.name == SOLVER else number
        figures = interleave(
            ('ours', 'by_hand'),
            rounds,
            lambda side, call=call, count=count: call.microseconds(side, count),
        )
        found[call.name] = list(zip(figures['ours'], figures['by_hand'], strict=True))
    gc.enable()
    return found


def rows(quick: bool) -> list[Row]:
    """Measure all sides in turn."""
    return [
        Row(
            group='single calls',
            ours=name,
            beside='by hand, unchecked',
            quantity='us per call',
            pairs=pairs,
            goal=Goal(MOST),
            digits=2,
        )
        for name, pairs in measured(quick).items()
    ]


def main() -> None:
    print(f'{"least of all rounds, us per call":40s}{"ours":>9s}{"by hand":>9s}{"ratio":>7s}')
    for name, pairs in measured(False, sys.argv[1:]).items():
        ours, other = (min(side) for side in zip(*pairs, strict=True))
        print(f'{name:40s}{ours:9.2f}{other:9.2f}{ours / other:7.2f}{"  *" * (ours > MOST * other)}')


if __name__ == '__main__':
    main()
