"""Every Jacobian and gradient of the library against central differences of the motion it describes."""

from __future__ import annotations

import importlib
import inspect
import itertools
import pkgutil

import numpy as np
import pytest

from diffdrive_jacobian import kinematics
from diffdrive_jacobian.kinematics import contact, diff_drive, se2
from diffdrive_jacobian.kinematics import inverse_velocity as iv
from diffdrive_jacobian.kinematics.differentiation import numerical_jacobian
from diffdrive_jacobian.kinematics.inverse_kinematics import pose_difference
from diffdrive_jacobian.kinematics.mobile_manipulator import (
    MobileManipulator,
    mobile_manipulator_jacobian,
)
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm, arm_forward_kinematics, arm_jacobian

COUNT = 200
STEP = 1e-5
MOUNTS = [(0.0, 0.0), (0.12, -0.07)]
CASES = []
"""Name of a derivative, function that returns it and its numeric value, and options of the function."""


def derivative(name, **options):
    """Let a function be a case of the test below, with each combination of its options."""

    def register(case):
        for chosen in itertools.product(*options.values()):
            CASES.append((name, case, dict(zip(options, chosen, strict=True))))
        return case

    return register


def differences(function, at=None, step=STEP):
    """Differentiate a function of (..., n) that gives (..., m); its third entry is an angle."""
    at = np.zeros((COUNT, 2)) if at is None else at
    steps, around = step * np.eye(at.shape[-1]), at[..., np.newaxis, :]
    change = function(around + steps) - function(around - steps)
    change[..., 2:] = se2.wrap_angle(change[..., 2:])
    return np.swapaxes(change, -1, -2) / (2.0 * step)


class Robots:
    """Random differential drives, and where a motion of their wheels takes them."""

    def __init__(self, rng):
        self.pose = rng.uniform([-3.0, -3.0, -np.pi], [3.0, 3.0, np.pi], (COUNT, 3))
        self.theta = self.pose[:, 2]
        self.r, self.L = 10.0 ** rng.uniform([-2.0, -1.5], [0.0, 0.5], (COUNT, 2)).T
        self.d = rng.choice([-1.0, 1.0], COUNT) * 10.0 ** rng.uniform(-2.0, 0.0, COUNT)

    def steered(self, way, turn):
        return se2.integrate(self.pose[:, np.newaxis], np.stack([way, turn], axis=-1), 1.0)

    def rolled(self, angles):
        """Turn the wheels by angles, right and left: each rim goes its way."""
        right, left = np.moveaxis(self.r[:, np.newaxis, np.newaxis] * angles, -1, 0)
        return self.steered((right + left) / 2.0, (right - left) / self.L[:, np.newaxis])

    def twist(self, angles):
        moved = se2.compose(se2.inverse(self.pose)[:, np.newaxis], self.rolled(angles))
        return se2.log(moved)[..., ::2]


@derivative('diff_drive.unicycle_jacobian')
def unicycle(rng):
    robots = Robots(rng)
    numeric = differences(lambda u: robots.steered(u[..., 0], u[..., 1]))
    return diff_drive.unicycle_jacobian(robots.theta), numeric


@derivative('diff_drive.wheel_to_body_jacobian')
def wheel_to_body(rng):
    robots = Robots(rng)
    return diff_drive.wheel_to_body_jacobian(robots.r, robots.L), differences(robots.twist)


@derivative('diff_drive.body_to_wheel_jacobian')
def body_to_wheel(rng):
    robots = Robots(rng)
    numeric = np.linalg.inv(differences(robots.twist))
    return diff_drive.body_to_wheel_jacobian(robots.r, robots.L), numeric


@derivative('diff_drive.wheel_to_world_jacobian')
def wheel_to_world(rng):
    robots = Robots(rng)
    jacobian = diff_drive.wheel_to_world_jacobian(robots.theta, robots.r, robots.L)
    return jacobian, differences(robots.rolled)


@derivative('diff_drive.wheel_to_position_jacobian')
def wheel_to_position(rng):
    robots = Robots(rng)
    jacobian = diff_drive.wheel_to_position_jacobian(robots.theta, robots.r, robots.L)
    return jacobian, differences(lambda angles: robots.rolled(angles)[..., :2])


@derivative('diff_drive.single_wheel_jacobian')
def single_wheel(rng):
    robots = Robots(rng)
    numeric = differences(lambda u: robots.steered(robots.r[:, np.newaxis] * u[..., 0], u[..., 1]))
    return diff_drive.single_wheel_jacobian(robots.theta, robots.r), numeric


@derivative('diff_drive.offset_point_jacobian')
def offset_point(rng):
    robots = Robots(rng)
    jacobian = diff_drive.offset_point_jacobian(robots.theta, robots.r, robots.L, robots.d)
    point = differences(lambda w: diff_drive.offset_point(robots.rolled(w), robots.d[:, np.newaxis]))
    return jacobian, point


@derivative('contact.wheel_contact_jacobian')
def wheel_contact(rng):
    r, q = 10.0 ** rng.uniform(-2.0, 0.0, COUNT), rng.uniform(-4.0, 4.0, (COUNT, 2))

    def point(q):
        return contact.wheel_contact_position(q[..., 0], q[..., 1], r[:, np.newaxis])

    return contact.wheel_contact_jacobian(q[:, 1], r), differences(point, q)


@derivative('se2.left_jacobian')
def left(rng):
    t = rng.uniform(-4.0, 4.0, (COUNT, 3))
    back = se2.inverse(se2.exp(t))[:, np.newaxis]

    def change(d):
        return se2.log(se2.compose(se2.exp(t[:, np.newaxis] + d), back))

    return se2.left_jacobian(t), differences(change, np.zeros((COUNT, 3)))


@derivative('se2.right_jacobian')
def right(rng):
    t = rng.uniform(-4.0, 4.0, (COUNT, 3))
    back = se2.inverse(se2.exp(t))[:, np.newaxis]

    def change(d):
        return se2.log(se2.compose(back, se2.exp(t[:, np.newaxis] + d)))

    return se2.right_jacobian(t), differences(change, np.zeros((COUNT, 3)))


@derivative('planar_arm.PlanarArm.jacobian', links=(1, 2, 5), heading=(False, True))
def planar_arm(rng, links, heading):
    arm, q = PlanarArm(rng.uniform(0.1, 1.0, links)), rng.uniform(-4.0, 4.0, (COUNT, links))
    numeric = differences(lambda q: arm.forward_kinematics(q)[..., : 3 if heading else 2], q)
    return arm.jacobian(q, heading=heading), numeric


@derivative(
    'mobile_manipulator.MobileManipulator.jacobian', links=(1, 3), heading=(False, True), mount=MOUNTS
)
def mobile_manipulator(rng, links, heading, mount):
    arm = PlanarArm(rng.uniform(0.1, 1.0, links))
    robot = MobileManipulator(r=0.05, L=0.3, arm=arm, mount=mount)
    q = rng.uniform(-4.0, 4.0, (COUNT, 3 + links))

    def tip(q_dot):
        there = robot.integrate(q[:, np.newaxis], q_dot, 1.0)
        return robot.forward_kinematics(there)[..., : 3 if heading else 2]

    return robot.jacobian(q, heading=heading), differences(tip, np.zeros((COUNT, 2 + links)))


@derivative('differentiation.numerical_jacobian', links=[3])
def any_function(rng, links):
    arm, q = PlanarArm(rng.uniform(0.1, 1.0, links)), rng.uniform(-4.0, 4.0, (COUNT, links))
    numeric = numerical_jacobian(arm.forward_kinematics, q, difference=pose_difference)
    return numeric, arm.jacobian(q, heading=True)


@derivative('planar_arm.arm_jacobian', links=[3])
def arm_of_lengths(rng, links):
    lengths, q = rng.uniform(0.1, 1.0, links), rng.uniform(-4.0, 4.0, (COUNT, links))
    numeric = differences(lambda q: arm_forward_kinematics(lengths, q)[..., :2], q)
    return arm_jacobian(lengths, q), numeric


@derivative('mobile_manipulator.mobile_manipulator_jacobian', links=[2])
def manipulator_of_lengths(rng, links):
    lengths, mount = rng.uniform(0.1, 1.0, links), MOUNTS[1]
    robot = MobileManipulator(r=0.05, L=0.3, arm=PlanarArm(lengths), mount=mount)
    q = rng.uniform(-4.0, 4.0, (COUNT, 3 + links))

    def tip(q_dot):
        return robot.forward_kinematics(robot.integrate(q[:, np.newaxis], q_dot, 1.0))

    jacobian = mobile_manipulator_jacobian(q[:, 2], q[:, 3:], lengths, mount, 0.05, 0.3)
    return jacobian, differences(tip, np.zeros((COUNT, 2 + links)))


@derivative('mobile_manipulator.MobileManipulator.configuration_jacobian', links=(1, 3))
def configuration(rng, links):
    arm = PlanarArm(rng.uniform(0.1, 1.0, links))
    robot, q = MobileManipulator(r=0.05, L=0.3, arm=arm), rng.uniform(-3.0, 3.0, (COUNT, 3 + links))

    def moved(u):
        return robot.integrate(q[:, np.newaxis], u, 1.0)

    return robot.configuration_jacobian(q), differences(moved, np.zeros((COUNT, 2 + links)))


@derivative('inverse_velocity.manipulability_gradient', links=(2, 3), heading=[False])
@derivative('inverse_velocity.manipulability_gradient', links=[4], heading=[True])
def manipulability(rng, links, heading):
    arm, q = PlanarArm(rng.uniform(0.3, 1.0, links)), rng.uniform(-4.0, 4.0, (COUNT, links))
    if links == 2:  # The measure has an edge where the arm is singular.
        q[:, 1] = rng.choice([-1.0, 1.0], COUNT) * rng.uniform(0.1, 3.0, COUNT)

    def jacobian(q):
        return arm.jacobian(q, heading=heading)

    def measure(q):
        J = jacobian(q)
        return np.sqrt(np.linalg.det(J @ np.swapaxes(J, -1, -2)))[..., np.newaxis]

    numeric = differences(measure, q)
    return iv.manipulability_gradient(jacobian, q)[:, np.newaxis], numeric


@derivative('inverse_velocity.joint_limit_gradient')
def joint_limit(rng):
    q, lower = rng.uniform(-4.0, 4.0, (2, COUNT, 5))
    upper = lower + rng.uniform(0.1, 6.0, (COUNT, 5))
    limits = lower[:, np.newaxis], upper[:, np.newaxis]
    numeric = differences(lambda q: iv.joint_limit_cost(q, *limits)[..., np.newaxis], q)
    return iv.joint_limit_gradient(q, lower, upper)[:, np.newaxis], numeric


@derivative('planar_arm.PlanarArm.clearance_gradient', links=[3])
def clearance(rng, links):
    # Not folded, and obstacles beside elbows and tip: no joint moves the base.
    arm, q = PlanarArm(rng.uniform(0.3, 1.0, links)), rng.uniform(-0.8, 0.8, (COUNT, links))
    beside = rng.uniform(-0.1, 0.1, (COUNT, 2))
    obstacle = arm.joint_positions(q)[range(COUNT), rng.integers(1, links + 1, COUNT)] + beside
    numeric = differences(lambda q: arm.clearance(q, obstacle[:, np.newaxis])[..., np.newaxis], q)
    return arm.clearance_gradient(q, obstacle)[:, np.newaxis], numeric


@pytest.mark.parametrize(
    ('r', 'q', 'message'),
    [
        (lambda q: q, 0.0, r'^q must have shape'),
        (lambda q: q, [np.nan], r'^q must be finite'),
        (lambda q: q[0], [1.0], r'^r\(q\) must have shape'),
        (lambda q: q * np.nan, [1.0], r'^r\(q\) must be finite'),
        (lambda q: [q], [1.0], r'^r\(q\) must have one shape \(m,\), got \(1, 1\)'),
        (lambda q: np.ones(1 + (q[0] > 0.0)), [0.0], r'^r\(q\) must have one shape'),
    ],
)
def test_only_functions_from_vectors_to_vectors_are_differentiated(r, q, message):
    with pytest.raises(ValueError, match=message):
        numerical_jacobian(r, q)


@pytest.mark.parametrize(
    ('case', 'options'),
    [pytest.param(case, options, id=f'{name} {options}') for name, case, options in CASES],
)
def test_it_is_the_derivative_of_the_motion(case, options):
    jacobian, numeric = case(np.random.default_rng(1), **options)
    assert jacobian.shape == numeric.shape == (COUNT, *numeric.shape[1:])
    error = np.linalg.norm(jacobian - numeric, axis=(-2, -1)) / np.linalg.norm(jacobian, axis=(-2, -1))
    assert error.max() < 1e-6


def derivatives_of_the_library():
    """Find every public function and method that is named as a derivative."""
    for info in pkgutil.walk_packages(kinematics.__path__, f'{kinematics.__name__}.'):
        if info.name.split('.')[-1].startswith('_'):
            continue
        members = vars(importlib.import_module(info.name))
        own = {name: m for name, m in members.items() if getattr(m, '__module__', None) == info.name}
        for name, member in list(own.items()):
            if inspect.isclass(member):
                own.update({f'{name}.{method}': m for method, m in vars(member).items()})
        for name, member in own.items():
            public = not any(part.startswith('_') for part in name.split('.'))
            if public and ('jacobian' in name.lower() or 'gradient' in name.lower()):
                assert inspect.isroutine(member), name
                yield f'{info.name.removeprefix(kinematics.__name__)}.{name}'[1:]


def test_no_jacobian_and_no_gradient_is_missing_here():
    assert set(derivatives_of_the_library()) == {name for name, _, _ in CASES}
