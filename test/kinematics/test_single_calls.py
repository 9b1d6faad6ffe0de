"""A single call of every public function of kinematics and control gives what a batch of one gives, also
for arguments that are invalid."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from diffdrive_jacobian import control
from diffdrive_jacobian.control import Arrival, StraightLine, VelocityLimits, Waypoints
from diffdrive_jacobian.kinematics import (
    contact,
    diff_drive,
    inverse_kinematics,
    inverse_velocity,
    rigid_body,
    spatial,
)
from diffdrive_jacobian.kinematics.mobile_manipulator import MobileManipulator
from diffdrive_jacobian.kinematics.planar_arm import PlanarArm

WHEELS = {'r': 0.033, 'L': 0.16}
POSE, GOAL, X_DOT = (0.3, -0.2, 1.0), (1.0, 2.0), (0.1, -0.2)
ARM, ROBOT = PlanarArm([1.0, 0.7]), MobileManipulator(0.033, 0.16, PlanarArm([1.0, 0.7]))
J, Q, WHOLE_Q = ARM.jacobian([0.5, 0.9]), (0.5, 0.9), (0.1, 0.2, 0.3, 0.5, 0.9)
WIDE = PlanarArm([0.5, 0.4, 0.3]).jacobian([0.1, 0.2, 0.3])
LIMITS = VelocityLimits(min_v=-0.1, max_v=0.22, min_omega=-2.0, max_omega=2.0, max_wheel_speed=10.0)
RANGE = {'q': Q, 'lower': (-3.0, -2.0), 'upper': (2.0, 2.5)}
LAW = {'state': POSE, 'goal': GOAL}
HERE, THERE = np.eye(4), np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
OPTIONS = {'limits', 'h', 'jacobian', 'tasks'}
"""Arguments that are not numbers, or that are in every call the same."""

CALLS = [
    (diff_drive.unicycle_jacobian, {'theta': 0.5}),
    (diff_drive.wheel_to_body_jacobian, WHEELS),
    (diff_drive.body_to_wheel_jacobian, WHEELS),
    (diff_drive.wheel_to_world_jacobian, {'theta': 0.5, **WHEELS}),
    (diff_drive.single_wheel_jacobian, {'theta': 0.5, 'r': 0.033}),
    (diff_drive.wheel_to_position_jacobian, {'theta': 0.5, **WHEELS}),
    (diff_drive.offset_point, {'pose': POSE, 'd': 0.1}),
    (diff_drive.offset_point_jacobian, {'theta': 0.5, **WHEELS, 'd': -0.1}),
    (diff_drive.body_to_wheel, {'v': 0.2, 'omega': 0.5, **WHEELS}),
    (diff_drive.wheel_to_body, {'omega_R': 2.0, 'omega_L': 3.0, **WHEELS}),
    (diff_drive.wheel_centres, {'pose': POSE, 'L': 0.16}),
    (diff_drive.wheel_centre_velocities, {'theta': 0.5, 'q_dot': POSE, 'L': 0.16}),
    (diff_drive.no_lateral_slip_constraint, {'theta': 0.5}),
    (diff_drive.lie_bracket, {'theta': 0.5}),
    (diff_drive.controllability_matrix, {'theta': 0.5}),
    (diff_drive.rolling_constraints, {'theta': 0.5, **WHEELS}),
    (contact.wheel_contact_position, {'x': 0.1, 'phi': 0.5, 'r': 0.033}),
    (contact.wheel_contact_jacobian, {'phi': 0.5, 'r': 0.033}),
    (rigid_body.point_velocity, {'v': POSE, 'omega': POSE, 'offset': (0.0, 0.1, 0.2)}),
    (spatial.spatial_displacement, {'T': HERE, 'T_desired': THERE}),
    (contact.rolling_direction, {'r': 0.033}),
    (inverse_velocity.adjugate_inverse, {'J': J}),
    (inverse_velocity.pseudoinverse, {'J': WIDE}),
    (inverse_velocity.damping, {'manipulability': 0.1, 'threshold': 0.2, 'maximum': 0.1}),
    (inverse_velocity.damped_least_squares, {'J': WIDE, 'x_dot': X_DOT, 'damping': 0.1}),
    (inverse_velocity.null_space_projector, {'J': WIDE, 'damping': 0.1}),
    (inverse_velocity.redundant, {'J': WIDE, 'x_dot': X_DOT, 'q_dot_0': POSE, 'damping': 0.0}),
    (inverse_velocity.manipulability, {'J': WIDE}),
    (inverse_velocity.velocity_ellipsoid, {'J': WIDE}),
    (inverse_velocity.force_ellipsoid, {'J': WIDE}),
    (inverse_velocity.smallest_singular_value, {'J': WIDE}),
    (inverse_velocity.condition_number, {'J': WIDE}),
    (inverse_velocity.masked_task, {'J': WIDE, 'x_dot': X_DOT, 'mask': (1.0, 0.5)}),
    (inverse_velocity.manipulability_gradient, {'jacobian': ARM.jacobian, 'q': Q}),
    (inverse_velocity.joint_limit_cost, RANGE),
    (inverse_velocity.joint_limit_gradient, RANGE),
    (inverse_velocity.limit_velocity, {'q_dot': POSE, 'max_velocity': (0.1, 0.4, 0.2)}),
    (inverse_velocity.prioritized, {'tasks': [(WIDE, X_DOT)], 'damping': 0.1}),
    (inverse_kinematics.pose_difference, {'target': (1.0, 2.0, 3.0), 'pose': (0.5, 0.5, -3.0)}),
    (ARM.joint_positions, {'q': Q}),
    (ARM.forward_kinematics, {'q': Q}),
    (ARM.jacobian, {'q': Q}),
    (ARM.determinant, {'q': Q}),
    (ARM.singular_configurations, {'q_1': 0.5}),
    (ARM.inverse_kinematics, {'position': (1.0, 0.5)}),
    (ARM.inverse_velocity, {'q': Q, 'x_dot': X_DOT}),
    (ARM.clearance, {'q': Q, 'obstacle': GOAL}),
    (ARM.clearance_gradient, {'q': Q, 'obstacle': GOAL}),
    (ARM.joint_torques, {'q': Q, 'wrench': (0.1, -0.2, 0.3)}),
    (ARM.integrate, {'q': Q, 'q_dot': X_DOT, 'dt': 0.1}),
    (ROBOT.forward_kinematics, {'q': WHOLE_Q}),
    (ROBOT.jacobian, {'q': WHOLE_Q}),
    (ROBOT.configuration_jacobian, {'q': WHOLE_Q}),
    (ROBOT.integrate, {'q': WHOLE_Q, 'q_dot': (3.0, 2.0, 0.1, 0.2), 'dt': 0.1}),
    (control.go_to_goal, {**LAW, 'Kp': 3.0, 'Kv': 0.5}),
    (control.offset_point, {**LAW, 'k': 0.5, 'd': 0.1}),
    (control.go_to_pose, {'state': POSE, 'goal': (1.0, 2.0, -1.0), 'Kp': 3.0, 'Kv': 0.5}),
    (control.turn_in_place, {'theta': 0.5, 'heading': 3.0, 'Kp': 3.0}),
    (control.saturate, {'v': 3.0, 'omega': 5.0, 'limits': LIMITS, **WHEELS}),
    (
        control.resolved_rate,
        {'J': J, 'x': Q, 'x_desired': GOAL, 'x_dot_desired': X_DOT, 'gain': 1.0}
        | {'damping': 0.1, 'max_correction': 0.3},
    ),
    (
        Arrival(offset=0.1).distance,
        {'x': 0.1, 'y': 0.2, 'theta': 0.5, 'x_goal': 1.0, 'y_goal': 2.0},
    ),
    (Arrival().faces, {'theta': 0.5, 'heading': 0.51}),
]
ELSEWHERE = {
    'solve',
    *('reached', 'stopped', 'remaining'),
    'follow',
    'resumed',
    'position',
    'all',
    'names',
    'find_controller',
    'controller_names',
    *('circle_path', 'figure_eight_path', 'line_path', 'planned_path'),
}
"""Functions without a batch, or tested in a file of their own."""
POSITIVE = {'r', 'L', 'threshold', 'max_velocity', 'max_correction'}
BAD = [np.nan, np.inf, -np.inf, 'text', '', None, 1j, 10**400, object(), b'1']
DIGITS = 8
"""Units in the last place of the largest entry. NumPy's functions may differ from those of `math`."""


def name_of(call):
    return getattr(call, '__qualname__', None)


def every(cases):
    return pytest.mark.parametrize(('call', 'valid'), cases, ids=name_of)


def batch_of_one(valid):
    """Add an axis of length one to every number and array."""
    return {name: value if name in OPTIONS else np.asarray([value]) for name, value in valid.items()}


def parts(result):
    return result if isinstance(result, tuple) else (result,)


def outcome(call, arguments):
    """Return the result, or the class of the error and its text up to the value."""
    try:
        return parts(call(**arguments)), None
    except (ValueError, TypeError) as error:
        return None, (type(error), str(error).partition(' got ')[0])


def test_every_public_function_is_called_here():
    called = {call.__name__ for call, _ in CALLS}
    for module in (contact, diff_drive, inverse_kinematics, inverse_velocity, rigid_body, spatial):
        for name, value in vars(module).items():
            own = inspect.isfunction(value) and value.__module__.startswith('diffdrive_jacobian')
            listed = name in getattr(module, '__all__', ()) or value in vars(module).values()
            if own and listed and value.__module__ == module.__name__ and not name.startswith('_'):
                assert name in called | ELSEWHERE
    assert {*inverse_velocity.__all__} - {'CUTOFF', 'FILTER', 'Ellipsoid'} <= called
    for name in control.__all__:
        if inspect.isfunction(getattr(control, name)):
            assert name in called | ELSEWHERE
    for cls in (PlanarArm, MobileManipulator, Arrival, VelocityLimits, Waypoints, StraightLine):
        for name, value in vars(cls).items():
            if inspect.isfunction(value) and not name.startswith('_'):
                assert name in called | ELSEWHERE


@every(CALLS)
def test_a_single_call_equals_a_batch_of_one(call, valid):
    single, batch = parts(call(**valid)), parts(call(**batch_of_one(valid)))
    assert len(single) == len(batch)
    for one, many in zip(single, batch, strict=True):
        lead = () if name_of(call) == 'prioritized' else (1,)
        assert np.shape(many)[: len(lead)] == lead
        assert np.shape(many)[-np.ndim(one) or None :] == np.shape(one) or np.ndim(one) == 0
        most = DIGITS * np.spacing(np.abs(np.asarray(one, dtype=np.float64)).max())
        np.testing.assert_allclose(np.reshape(many, np.shape(one)), one, rtol=0.0, atol=most)


@every(CALLS)
def test_other_numbers_and_sequences_give_the_same_bits(call, valid):
    """Arrays of NumPy's floats, lists and tuples are the same as floats."""
    expected = parts(call(**valid))
    for convert in (
        lambda value: np.asarray(value, dtype=np.float64)[()],
        lambda value: np.array(value, dtype=np.float64),
        lambda value: np.asarray(value).tolist(),
        lambda value: tuple(value) if np.ndim(value) == 1 else value,
    ):
        converted = {name: value if name in OPTIONS else convert(value) for name, value in valid.items()}
        for one, other in zip(expected, parts(call(**converted)), strict=True):
            assert type(one) is type(other)
            assert np.array_equal(one, other)


@every(
    [
        pytest.param(call, valid, id=name_of(call))
        for call, valid in CALLS
        if all(name not in OPTIONS and np.ndim(value) == 0 for name, value in valid.items())
    ]
)
def test_integers_and_booleans_are_numbers(call, valid):
    for number in (1, True, np.int8(1), np.float32(1.0)):
        expected = parts(call(**dict.fromkeys(valid, 1.0)))
        for one, other in zip(expected, parts(call(**dict.fromkeys(valid, number))), strict=True):
            assert type(one) is type(other)
            assert np.array_equal(one, other)


def invalid():
    for call, valid in CALLS:
        for name in (name for name in valid if name not in OPTIONS):
            yield pytest.param(call, valid, name, id=f'{name_of(call)}-{name}')


def spoiled(value, bad):
    """Put a bad entry into the first place of an argument."""
    if np.ndim(value) == 0:
        return bad
    entries = np.array(value, dtype=object)
    entries[(0,) * entries.ndim] = bad
    return entries.tolist()


@pytest.mark.parametrize(('call', 'valid', 'name'), list(invalid()))
def test_invalid_numbers_raise_the_same_error_as_in_a_batch(call, valid, name):
    bad_values = BAD + [-1.0, 0.0] * (name in POSITIVE) + [0.0] * (name == 'd')
    for bad in bad_values:
        if bad is None and call is control.saturate and name in WHEELS:
            continue  # None is the default.
        argument = spoiled(valid[name], bad)
        single = outcome(call, valid | {name: argument})
        batch = outcome(call, batch_of_one(valid) | {name: [argument]})
        assert single[1] == batch[1]
        if single[1] is None:
            # An infinite limit means none. An offset point may be the axle centre.
            assert (name, bad) in {
                ('max_correction', np.inf),
                ('max_velocity', np.inf),
                ('d', 0.0),
            }
        else:
            assert single[1][0] is ValueError
            assert single[1][1].startswith(name)


@pytest.mark.parametrize(('call', 'valid', 'name'), list(invalid()))
def test_wrong_shapes_are_refused_or_broadcast(call, valid, name):
    """Never a result of another shape than that of all arguments together."""
    for wrong in ([], (1.0,) * 6, np.zeros((0, 3)), [[1.0], [2.0, 3.0]], ((),)):
        result, error = outcome(call, valid | {name: wrong})
        if error is None:
            # A number became an array, or a vector an empty batch of vectors.
            lead = np.shape(wrong) if np.ndim(valid[name]) == 0 else np.shape(wrong)[:-1]
            assert all(np.shape(part)[: len(lead)] == lead for part in result)
        else:
            assert error[0] is ValueError
            assert any(argument in error[1] for argument in valid)


@pytest.mark.parametrize('heading', [False, True])
@pytest.mark.parametrize('limits', [None, (-2.0, 2.0)])
def test_inverse_kinematics_of_one_target_is_that_of_a_batch(heading, limits):
    """The same steps: reached at once, after restarts, at limits, or out of reach."""
    arm, rng = PlanarArm([0.5, 0.4, 0.3]), np.random.default_rng(3)
    entries = 3 if heading else 2

    def forward(q):
        return arm.forward_kinematics(q)[..., :entries]

    targets = forward(rng.uniform(-1.5, 1.5, (12, 3)))
    targets[0, :2], targets[1] = 3.0, forward(np.zeros(3))
    starts = rng.uniform(-1.9, 1.9, (12, 3))
    starts[2], starts[3] = 0.0, [2.0, -2.0, 2.0]
    options = {'limits': limits, 'restarts': 3, 'max_iterations': 100}
    if heading:
        options |= {'difference': inverse_kinematics.pose_difference, 'mask': [1.0, 4.0, 0.5]}

    def jacobian(q):
        return arm.jacobian(q, heading=heading)

    batch = inverse_kinematics.solve(forward, jacobian, targets, starts, **options)
    assert batch.converged.any()
    for index, (target, start) in enumerate(zip(targets, starts, strict=True)):
        single = inverse_kinematics.solve(forward, jacobian, target, start, **options)
        for name in ('converged', 'iterations', 'restarts', 'start'):
            assert getattr(single, name) == getattr(batch, name)[index]
        np.testing.assert_allclose(single.q, batch.q[index], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(single.error, batch.error[index], rtol=1e-6, atol=1e-12)


def test_the_law_of_one_step_of_the_node_takes_floats_alone():
    """Its results are floats, not NumPy's: messages and saturation take floats."""
    for pose in (POSE, np.array(POSE), list(POSE)):
        twist = control.go_to_goal(pose, GOAL, 3.0, 0.5)
        twist = control.saturate(*twist, LIMITS, **WHEELS)
        assert [type(entry) for entry in twist] == [float, float]
