"""Every public function and class of control, simulation, diff_drive, rigid_body and se2, given invalid
arguments: a ValueError that names the argument, or a finite result, and the same for one robot and for
a batch."""

from __future__ import annotations

import dataclasses
import inspect
import re

import numpy as np
import pytest

from diffdrive_jacobian import control, simulation
from diffdrive_jacobian.control import Arrival, StraightLine, VelocityLimits, Waypoints
from diffdrive_jacobian.kinematics import diff_drive, rigid_body, se2
from diffdrive_jacobian.simulation import Drift, Robot, RobotModel, odometry_noise
from diffdrive_jacobian.simulation.closed_loop import Outcomes

POSE, TWIST, GOAL = (0.3, -0.2, 1.0), (0.2, 0.5), (1.0, 2.0)
WHEELS = {'r': 0.033, 'L': 0.16}
LIMITS = VelocityLimits(min_v=-0.1, max_v=0.22, min_omega=-2.0, max_omega=2.0, max_wheel_speed=10.0)
MODEL = RobotModel(limits=LIMITS, command_timeout=10**9)
ROBOT = Robot(model=MODEL, stamp=0, pose=np.array(POSE)).commanded(TWIST, 0)
DRIFTING = Robot(model=dataclasses.replace(MODEL, drift=Drift(seed=3)), stamp=0, pose=np.array(POSE))
COVARIANCE = np.diag([1e-4, 1e-4, 1e-3])
LINE = StraightLine([0.0, 0.0], [1.0, 0.0], 0.1)
WAYPOINTS = Waypoints([[1.0, 0.0, 0.0], [1.0, 1.0, 2.0]])
LOOP = {'starts': POSE, 'goals': GOAL, 'rate': 10.0, 'duration': 0.5, 'turning_gain': 3.0, **WHEELS}
ODOMETRY = {'L': 0.16, 'wheel_travel_variance': 1e-5}


def law(pose, goal):
    return 0.1, 0.2


def closed_loops(starts, goals, **options):
    return simulation.closed_loops(
        options.pop('law', control.go_to_goal), starts, goals, 3.0, 0.5, **options
    )


def trajectories(starts, goals, **options):
    return simulation.trajectories(
        options.pop('law', control.go_to_goal), starts, goals, 3.0, 0.5, **options
    )


FUNCTIONS = {
    diff_drive.unicycle_jacobian: {'theta': 0.5},
    diff_drive.wheel_to_body_jacobian: WHEELS,
    diff_drive.body_to_wheel_jacobian: WHEELS,
    diff_drive.wheel_to_world_jacobian: {'theta': 0.5, **WHEELS},
    diff_drive.single_wheel_jacobian: {'theta': 0.5, 'r': 0.033},
    diff_drive.wheel_to_position_jacobian: {'theta': 0.5, **WHEELS},
    diff_drive.offset_point: {'pose': POSE, 'd': 0.1},
    diff_drive.offset_point_jacobian: {'theta': 0.5, **WHEELS, 'd': 0.1},
    diff_drive.body_to_wheel: {'v': 0.2, 'omega': 0.5, **WHEELS},
    diff_drive.wheel_to_body: {'omega_R': 2.0, 'omega_L': 3.0, **WHEELS},
    diff_drive.wheel_centres: {'pose': POSE, 'L': 0.16},
    diff_drive.wheel_centre_velocities: {'theta': 0.5, 'q_dot': POSE, 'L': 0.16},
    diff_drive.no_lateral_slip_constraint: {'theta': 0.5},
    diff_drive.lie_bracket: {'theta': 0.5},
    diff_drive.controllability_matrix: {'theta': 0.5},
    diff_drive.rolling_constraints: {'theta': 0.5, **WHEELS},
    rigid_body.point_velocity: {'v': POSE, 'omega': POSE, 'offset': POSE},
    se2.wrap_angle: {'angle': 4.0},
    se2.sinc: {'angle': 0.5},
    se2.exp: {'twist': POSE},
    se2.log: {'pose': POSE},
    se2.compose: {'first': POSE, 'second': POSE},
    se2.inverse: {'pose': POSE},
    se2.homogeneous: {'pose': POSE},
    se2.homogeneous_3d: {'pose': POSE},
    se2.adjoint: {'pose': POSE},
    se2.left_jacobian: {'twist': POSE},
    se2.right_jacobian: {'twist': POSE},
    se2.integrate: {'pose': POSE, 'twist': TWIST, 'dt': 0.5},
    control.go_to_goal: {'state': POSE, 'goal': GOAL, 'Kp': 3.0, 'Kv': 0.5},
    control.turn_in_place: {'theta': 0.5, 'heading': 3.0, 'Kp': 3.0},
    control.offset_point: {'state': POSE, 'goal': GOAL, 'k': 0.5, 'd': 0.1},
    control.go_to_pose: {'state': POSE, 'goal': POSE[::-1], 'Kp': 3.0, 'Kv': 0.5, 'h': 2.0},
    control.saturate: {'v': 3.0, 'omega': 5.0, 'limits': LIMITS, **WHEELS},
    odometry_noise.twist_covariance: {'twist': TWIST, **ODOMETRY, 'interval': 0.02},
    odometry_noise.propagate_covariance: {
        **{'covariance': COVARIANCE, 'pose': POSE, 'twist': TWIST, 'dt': 0.5},
        **ODOMETRY,
    },
    Arrival().distance: {'x': 0.1, 'y': 0.2, 'theta': 0.5, 'x_goal': 1.0, 'y_goal': 2.0},
    Arrival().faces: {'theta': 0.5, 'heading': 3.0},
}
"""Functions that broadcast, with valid arguments for one robot."""
OTHERS = {
    VelocityLimits: {'min_v': -1.0, 'max_v': 1.0, 'min_omega': -1.0, 'max_omega': 1.0}
    | {'max_wheel_speed': 9.0},
    Arrival: {
        **{'xy_tolerance': 0.02, 'yaw_tolerance': 0.02, 'use_heading': True, 'offset': 0.1},
        **dict.fromkeys(('trans_stopped_velocity', 'rot_stopped_velocity'), 0.1),
    },
    Waypoints: {'poses': [POSE], 'index': 0, 'turning': False},
    WAYPOINTS.follow: {'pose': POSE, 'law': law, 'arrival': Arrival(), 'turning_gain': 3.0},
    StraightLine: {'start': [0.0, 0.0], 'end': [1.0, 0.0], 'speed': 0.1},
    LINE.position: {'t': 0.5},
    Drift: {'seed': 3, 'right_wheel_radius_multiplier': 1.01, 'left_wheel_radius_multiplier': 0.99}
    | {'wheel_separation_multiplier': 1.02},
    RobotModel: {
        **{'wheel_radius': 0.033, 'wheel_separation': 0.16, 'limits': LIMITS},
        **{'command_timeout': 10**9, 'wheel_travel_variance': 1e-5, 'drift': Drift(seed=3)},
    },
    MODEL.limited: {'command': TWIST},
    Robot: {
        **{'model': MODEL, 'stamp': 0, 'pose': POSE, 'covariance': COVARIANCE},
        **{'wheel_angles': TWIST, 'command': TWIST, 'twist': TWIST, 'commanded_at': 0},
    },
    ROBOT.at: {'stamp': 5},
    ROBOT.commanded: {'command': TWIST, 'stamp': 5},
    ROBOT.placed: {'pose': POSE, 'covariance': COVARIANCE, 'stamp': 5},
    ROBOT.reported: {'pose': POSE, 'wheel_angles': TWIST, 'twist': TWIST},
    DRIFTING.pushed: {'displacement': POSE, 'stamp': 5},
    ROBOT.remodelled: {'model': MODEL, 'stamp': 5},
    ROBOT.restarted: {'stamp': 5},
    ROBOT.twist_covariance: {'interval': 0.02},
    ROBOT.twist_covariance_tuple: {'interval': 0.02},
    closed_loops: {'law': control.go_to_goal, **LOOP, 'arrival': Arrival(), 'limits': LIMITS}
    | {'progress': None},
    trajectories: {'law': control.go_to_goal, **LOOP, 'arrival': Arrival(), 'limits': LIMITS},
}
CALLS = FUNCTIONS | OTHERS
ELSEWHERE = {
    *('resolved_rate', 'track_line'),
    *('Path', 'PathController', 'PathError', 'Reference', 'follow_path'),
    *('circle_path', 'figure_eight_path', 'line_path', 'planned_path'),
    *('Boundary', 'Controller', 'ControllerError', 'Controllers', 'Gain', 'LawError'),
    *('controller_names', 'find_controller', 'KP', 'KV', 'OFFSET'),
    *('Sweep', 'SweepSetup', 'describe_sweep', 'sweep', 'sweep_table'),
}
"""Tested in test_resolved_rate, test_path_laws, test_path_source and test_sweep_gains, among others."""
OPTIONAL = {'h', 'arrival', 'progress', 'commanded_at', 'seed', 'drift'}
"""Arguments that may be None."""

NOT_NUMBERS = [None, 'text', '', b'1', 1j, object(), {}, [1.0, [2.0, 3.0]], 10**400, 10**5000, float]
NOT_FINITE = [np.nan, np.inf, -np.inf]
EXTREME = [1e308, -1e308, 1e200, -1e200, 1e-200, 5e-324, -5e-324, 0.0, -1.0, 10**30]
WRONG_SHAPE = [[], [1.0], [1.0] * 5, np.zeros((2, 2)), np.zeros((0, 3)), np.zeros((7, 4, 4))]


def name_of(call):
    return getattr(call, '__qualname__', call)


def arguments_and(values, *, valid=lambda name, value: False):
    """Return a test's parameter for each call: with each argument in turn, each of these values in it.

    Pairs for which `valid` returns True are left out.
    """
    return [
        pytest.param(
            call,
            [(name, value) for name in arguments for value in values if not valid(name, value)],
            id=name_of(call),
        )
        for call, arguments in CALLS.items()
    ]


def may_be(name, value):
    """Return whether something that is no number is valid for an argument."""
    return (value is None and name in OPTIONAL) or (callable(value) and name in ('law', 'progress'))


def refused(call, name, value):
    with pytest.raises(ValueError, match=rf'\b{name}\b'):
        call(**CALLS[call] | {name: value})


def spoiled(valid, value):
    """Put a value into each place of an argument in turn."""
    if isinstance(valid, (float, int)) or not isinstance(valid, (tuple, list, np.ndarray)):
        return [value]
    made = []
    for index in np.ndindex(np.shape(valid)):
        entries = np.array(valid, dtype=np.float64)
        try:
            entries[index] = value
        except OverflowError:
            continue
        made.append(entries)
    return made


def numbers(result):
    """Yield every number of a result; NaN is allowed as the time of a robot that has not arrived."""
    if isinstance(result, Outcomes):
        assert np.all(np.isnan(result.time) == ~result.arrived)
        result = result._replace(time=np.nan_to_num(result.time))
    if isinstance(result, (VelocityLimits, Arrival)):
        return  # infinite limits mean none
    if dataclasses.is_dataclass(result):
        result = [getattr(result, field.name) for field in dataclasses.fields(result)]
    if isinstance(result, (tuple, list)):
        for entry in result:
            yield from numbers(entry)
    elif isinstance(result, (bool, int, float, np.ndarray, np.generic)):
        yield from np.ravel(result).tolist()


def assert_named_or_finite(call, name, value):
    message = ''
    try:
        result = call(**CALLS[call] | {name: value})
    except ValueError as error:
        message = str(error)
    if message:
        assert re.search(rf'\b{name}\b', message), (name, value)
    else:
        assert all(map(np.isfinite, numbers(result))), (name, value)


def test_every_public_function_is_called_here():
    called = {name_of(call).split('.')[0] for call in CALLS}
    public = {*control.__all__, *simulation.__all__} - ELSEWHERE
    for module in (diff_drive, rigid_body, se2):
        public |= {
            name
            for name, value in vars(module).items()
            if inspect.isfunction(value)
            and value.__module__ == module.__name__
            and not name.startswith('_')
        }
    assert public <= called
    for cls, instance in ((Robot, ROBOT), (RobotModel, MODEL), (Arrival, Arrival())):
        methods = {
            name
            for name, value in vars(cls).items()
            if inspect.isfunction(value) and not name.startswith('_')
        }
        tested = {call.__name__ for call in CALLS if getattr(call, '__self__', None) == instance}
        # These are without checks, for every message.
        assert methods - {'reached', 'stopped', 'wheel_speeds', 'twist'} <= tested | {
            call.__name__ for call in CALLS if isinstance(getattr(call, '__self__', None), cls)
        }


@pytest.mark.parametrize('call', CALLS, ids=name_of)
def test_the_valid_arguments_are_valid(call):
    result = call(**CALLS[call])
    assert result is not None


@pytest.mark.parametrize(('call', 'wrong'), arguments_and(NOT_NUMBERS, valid=may_be))
def test_what_is_no_number_is_named(call, wrong):
    for name, value in wrong:
        refused(call, name, value)


@pytest.mark.parametrize(('call', 'wrong'), arguments_and(NOT_FINITE))
def test_what_is_not_finite_is_named(call, wrong):
    for name, value in wrong:
        for bad in spoiled(CALLS[call][name], value):
            if np.isinf(value) and (call is VelocityLimits or name.endswith('stopped_velocity')):
                # No limit.
                assert_named_or_finite(call, name, bad)
            else:
                refused(call, name, bad)


@pytest.mark.parametrize(('call', 'extreme'), arguments_and(EXTREME))
def test_what_is_extreme_is_named_or_gives_a_finite_result(call, extreme):
    for name, value in extreme:
        for bad in spoiled(CALLS[call][name], value):
            assert_named_or_finite(call, name, bad)


@pytest.mark.parametrize(('call', 'other'), arguments_and(WRONG_SHAPE))
def test_another_shape_is_named_or_broadcasts(call, other):
    for name, value in other:
        assert_named_or_finite(call, name, value)


@pytest.mark.parametrize('call', FUNCTIONS, ids=name_of)
def test_one_robot_and_a_batch_of_it_give_the_same_result_or_the_same_error(call):
    """Also where a result overflows, and where only some of the arguments are arrays."""
    valid = FUNCTIONS[call]

    def outcome(arguments):
        try:
            return call(**arguments), ''
        except ValueError as error:
            return None, str(error)

    for name in valid:
        if name == 'limits':
            continue
        for value in (*EXTREME[:-1], 1e154, 1e155, 1e160, 1e-160, 3.0):
            for bad in spoiled(valid[name], value):
                single, error = outcome(valid | {name: bad})
                for others in (False, True):
                    batch = {
                        key: np.array([argument, argument])
                        for key, argument in {**valid, name: bad}.items()
                        if key != 'limits' and (others or key == name)
                    }
                    batched, batched_error = outcome(valid | batch)
                    assert bool(error) == bool(batched_error), (name, bad)
                    if 'overflows' in error:
                        assert error == batched_error
                    if error:
                        continue
                    for one, many in zip(_parts(single), _parts(batched), strict=True):
                        for row in np.broadcast_to(many, (2, *np.shape(one))):
                            np.testing.assert_allclose(row, one, rtol=1e-12, atol=1e-300)


def _parts(result):
    return result if isinstance(result, tuple) else (result,)
