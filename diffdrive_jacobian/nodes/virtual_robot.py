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

"""The node virtual_robot: a differential-drive robot that follows commands and publishes odometry.

The unicycle model is integrated exactly. The motion depends on the commands and their times only, not on
`publish_rate` or on the jitter of timers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    TransformStamped,
    Twist,
    TwistStamped,
)
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.clock import JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from diffdrive_jacobian.kinematics.se2 import wrap_angle
from diffdrive_jacobian.messages.codecs import (
    JOINT_STATE,
    ODOMETRY,
    POSE_WITH_COVARIANCE,
    TWIST,
    TWIST_STAMPED,
    Command,
    Motion,
    Place,
    Wheels,
)
from diffdrive_jacobian.messages.conversion import (
    SMALLEST,
    MessageError,
    command_time,
    from_covariance,
    plausible_twist,
    set_time,
)
from diffdrive_jacobian.messages.topic_faults import GOALS_LOST, SEVERAL, UNPUBLISHED
from diffdrive_jacobian.nodes.robot_defects import RobotDefects
from diffdrive_jacobian.parameters.virtual_robot import VirtualRobotParameters
from diffdrive_jacobian.ros.graph_faults import Interleaving, topic_check
from diffdrive_jacobian.ros.node import NO_CLOCK, ParameterizedNode
from diffdrive_jacobian.ros.rclpy_internals import change_timer_period, log_info
from diffdrive_jacobian.simulation.robot import Robot
from diffdrive_jacobian.text import printable
from diffdrive_jacobian.time_units import nanoseconds, seconds

__all__ = ['VirtualRobot']


class VirtualRobot(ParameterizedNode[VirtualRobotParameters]):
    """Node that subscribes to `cmd_vel` or `joint_command` and publishes `odom`, `joint_states`,
    `cmd_vel_out`, `start_pose` and a transform. `initialpose` and `reset_odometry` set its pose. If its
    wheels slip or are not as nominal, it also publishes `ground_truth`.

    A command takes effect at its stamp, or on receipt if it has none. `cmd_vel_out` has each command as
    it was applied, `start_pose` the pose and the time at which the odometry started. Together they
    determine the motion.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create the robot at its initial pose. `kwargs` as for `ParameterizedNode`."""
        super().__init__('virtual_robot', VirtualRobotParameters(), **kwargs)
        self._robot: Robot | None = None
        """The robot at the last event. None: simulated time has not started."""
        self._latest = 0
        self.defects = RobotDefects(self)
        """What is wrong with the robot beyond its parameters, for tests."""
        self._configure()
        self._odom = self.advertise(Odometry, 'odom')
        self._joint_states = self.advertise(JointState, 'joint_states')
        self._applied = self.advertise(TwistStamped, 'cmd_vel_out')
        self._start_pose = self.advertise(PoseWithCovarianceStamped, 'start_pose', latched=True)
        drifts = self.parameters.drift() is not None
        self._ground_truth: Publisher | None = None
        if drifts:
            self._ground_truth = self.advertise(Odometry, 'ground_truth')
        self._transforms = self._transform_broadcaster() if self.parameters.enable_odom_tf else None
        self._numbers = Interleaving()
        commands: dict[str, Any] = {'called': 'command', 'numbers': self._numbers}
        if self.parameters.command_interface == 'wheels':
            source = 'joint_command'
            self.subscribe(JointState, source, self._on_wheels, codec=JOINT_STATE, **commands)
            self.watch(topic_check(self, UNPUBLISHED, source))
        else:
            source, stamped = 'cmd_vel', self.parameters.enable_stamped_cmd_vel
            kind, codec = (TwistStamped, TWIST_STAMPED) if stamped else (Twist, TWIST)
            self.subscribe(kind, source, self._on_command, codec=codec, **commands)
        self.watch(topic_check(self, SEVERAL, 'odom'))
        # Paths are published for other reasons, too.
        for name in ('goal_pose', 'goals'):
            self.watch(topic_check(self, GOALS_LOST, name))
        self.subscribe(
            PoseWithCovarianceStamped, 'initialpose', self._on_initial_pose, codec=POSE_WITH_COVARIANCE
        )
        self.provide(Trigger, 'reset_odometry', self._on_reset)
        self._timer = self.create_timer(1.0 / self.parameters.publish_rate, self._on_tick)
        self._first_clock: JumpHandle | None = None
        self._jumps = self._watch_jumps()
        self._advance()
        self.announce(subscribed=[source], publishing=['odom', 'ground_truth'] if drifts else ['odom'])

    # --- Time

    def _watch_jumps(self) -> JumpHandle:
        """Advance the robot when simulated time starts or time goes back, before the next message."""
        clock = self.get_clock()
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1))
        if self.now() == 0:
            # It stays registered until the next tick: rcl skips a callback if another one is removed
            # while they are called.
            first = JumpThreshold(min_forward=Duration(nanoseconds=1), min_backward=None)
            self._first_clock = clock.create_jump_callback(first, post_callback=self._on_first_clock)
        return clock.create_jump_callback(back, post_callback=lambda _: self._advance())

    def _on_first_clock(self, _: TimeJump) -> None:
        if self._robot is None:
            self._advance()

    def _advance(self) -> tuple[int, Robot] | None:
        """Apply a timeout or a jump of time that happened since the last call.

        Return the current time (ns) and the robot. None: simulated time has not started.
        """
        now = self.now()
        if now == 0:
            return None
        robot = self._robot
        if robot is None:
            model = self.defects.model(self._model)
            robot = Robot(model=model, stamp=now, pose=self._initial_pose())
            self._publish_start(robot)
        elif now < self._latest:
            self.log_event_warning(
                'time went back',
                f'time went back by {seconds(self._latest - now):.3f} s: '
                'the robot stops at its present pose',
            )
            robot = robot.at(self._latest).restarted(now)
            self.defects.placed(robot)
            self._publish_start(robot)
            self._publish_applied(robot)
        elif (expiry := robot.expiry) is not None and expiry <= now:
            robot = robot.at(expiry)
            self._publish_applied(robot)
        self._robot, self._latest = robot, now
        return now, robot

    def time_and_robot(self) -> tuple[int, Robot]:
        """Return the time (ns), and the robot as of its last event until then.

        Raises:
            MessageError: Simulated time has not started.
        """
        advanced = self._advance()
        if advanced is None:
            raise MessageError(NO_CLOCK)
        return advanced

    def _publish_start(self, robot: Robot) -> None:
        """Publish the pose and the time at which the odometry starts."""
        place = Place(robot.stamp, robot.pose_tuple, robot.covariance_tuple)
        self._start_pose.publish(self._write_start(place))

    def _on_tick(self) -> None:
        advanced = self._advance()
        if advanced is None:
            return
        if self._first_clock is not None:
            self._first_clock.unregister()
            self._first_clock = None
        now, robot = advanced
        present = robot.at(now)
        reported = self.defects.reported(present)
        odometry = Motion(
            now,
            reported.pose_tuple,
            reported.twist,
            reported.covariance_tuple,
            reported.twist_covariance_tuple(self._period),
        )
        self._odom.publish(self._write_odometry(odometry))
        wheels = Wheels.of(now, self._wheel_names, reported.wheel_speeds, reported.wheel_angles)
        self._joint_states.publish(self._write_joints(wheels))
        if self._ground_truth is not None:
            truth = Motion(now, present.true_pose_tuple, present.true_twist)
            self._ground_truth.publish(self._write_truth(truth))
        if self._transforms is not None:
            frames = self._frame, self.parameters.base_frame_id
            self._transforms.sendTransform(transform_of(odometry, *frames))

    # --- Commands

    def _on_wheels(self, wheels: Wheels) -> None:
        """Apply wheel speeds as the twist that they mean."""
        speeds = wheels.speeds(self._wheel_names)
        # Not later: the twist of such speeds is zero.
        self.warn_of_integers('a command on joint_command', *speeds)
        v, omega = self._model.twist(*speeds)
        self._on_command(Command(plausible_twist(v, omega), wheels.stamp))

    def _on_command(self, command: Command) -> None:
        """Apply a command at its stamp, or now if it has none."""
        now, robot = self.time_and_robot()
        (v, omega), stamp = command
        time = command_time(stamp, now, robot.stamp, robot.model.command_timeout)
        if v or omega:
            self._numbers.count()
            # Not a call for each message.
            if 0.0 < abs(v) < SMALLEST or 0.0 < abs(omega) < SMALLEST:
                self.warn_of_integers('a command', v, omega)
        self._robot = robot.commanded((v, omega), time)
        self._publish_applied(self._robot)

    def _publish_applied(self, robot: Robot) -> None:
        """Publish the twist that the robot is to reach, with the time from which it follows it."""
        self._applied.publish(self._write_command(Command(robot.target, robot.stamp)))

    # --- Pose

    def _on_initial_pose(self, place: Place) -> None:
        """Place the robot now: the stamp does not matter."""
        now, robot = self.time_and_robot()
        if place.frame not in ('', self._frame):
            raise MessageError(
                f"its frame must be '{printable(self._frame)}', got '{printable(place.frame)}'"
            )
        self.warn_of_integers('initialpose', *place.pose)
        covariance = from_covariance(place.covariance)
        self.place(robot.placed(np.array(place.pose), covariance, now))

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            now, robot = self.time_and_robot()
        except MessageError as error:
            response.message = str(error)
            return response
        self.place(robot.placed(self._initial_pose(), np.zeros((3, 3)), now, odometry_only=True))
        x, y, theta = self._initial_pose()
        response.success = True
        response.message = f'odometry was reset to x {x:.3f}, y {y:.3f}, theta {theta:.3f}'
        return response

    def follow(self, robot: Robot) -> None:
        """Go on with another robot, of which the odometry notices nothing."""
        self._robot = robot

    def place(self, robot: Robot) -> None:
        """Go on with another robot, whose odometry starts again at its pose."""
        self._robot = robot
        self.defects.placed(robot)
        self._publish_start(robot)
        x, y, theta = robot.pose
        self.log_event_info('pose set', f'pose set to x {x:.3f}, y {y:.3f}, theta {theta:.3f}')

    @property
    def pose(self) -> NDArray[np.float64]:
        """`[x, y, theta]` by the odometry now, shape (3,) (m, m, rad).

        With encoders of few steps: at their last reading, as it was published.
        """
        robot = self._robot_now()
        return self._initial_pose() if robot is None else self.defects.odometry_pose(robot)

    @property
    def truth(self) -> NDArray[np.float64]:
        """`[x, y, theta]` where the robot truly is now, shape (3,) (m, m, rad)."""
        robot = self._robot_now()
        return self._initial_pose() if robot is None else robot.true_pose.copy()

    def _robot_now(self) -> Robot | None:
        return None if self._robot is None else self._robot.at(max(self.now(), self._latest))

    # --- Parameters

    def parameters_changed(self, previous: VirtualRobotParameters) -> None:
        """Continue with the new parameters."""
        parameters = self.parameters
        self._configure()
        if parameters.publish_rate != previous.publish_rate:
            change_timer_period(self._timer, nanoseconds(1.0 / parameters.publish_rate))
        self.remodel()

    def remodel(self) -> None:
        """Go on with the model of the present parameters and defects."""
        advanced = self._advance()
        model = self.defects.model(self._model)
        if model.drift is not None and self._ground_truth is None:
            self._ground_truth = self.advertise(Odometry, 'ground_truth')
        if advanced is not None and model != advanced[1].model:
            now, robot = advanced
            wheels = self.parameters.command_interface == 'wheels'
            self._robot = robot.remodelled(model, now, wheels_commanded=wheels)
            # From when on other accelerations apply is the time of this message in a bag.
            takes_time = model.takes_time or robot.model.takes_time
            if self._robot.target != robot.target or takes_time:
                self._publish_applied(self._robot)

    def _initial_pose(self) -> NDArray[np.float64]:
        parameters = self.parameters
        return np.array([parameters.x, parameters.y, wrap_angle(parameters.theta)])

    def _configure(self) -> None:
        """Compute from the parameters what every message needs: the model, frames and joints."""
        parameters = self.parameters
        self._model = parameters.model()
        self._period = 1.0 / parameters.publish_rate
        self._wheel_names = parameters.wheel_names
        self._frame = parameters.odom_frame_id
        of_odometry, of_body = Header(frame_id=self._frame), Header(frame_id=parameters.base_frame_id)
        of_truth = Header(frame_id=parameters.ground_truth_frame_id)
        child = parameters.base_frame_id
        self._write_odometry = ODOMETRY.writer(Odometry(header=of_odometry, child_frame_id=child))
        self._write_truth = ODOMETRY.writer(Odometry(header=of_truth, child_frame_id=child))
        self._write_start = POSE_WITH_COVARIANCE.writer(PoseWithCovarianceStamped(header=of_odometry))
        self._write_command = TWIST_STAMPED.writer(TwistStamped(header=of_body))
        joints = JointState(name=[*self._wheel_names], position=[0.0, 0.0], velocity=[0.0, 0.0])
        self._write_joints = JOINT_STATE.writer(joints)

    def _transform_broadcaster(self) -> Any | None:
        try:
            from tf2_ros import TransformBroadcaster
        except ImportError:
            log_info(self, 'tf2_ros is not installed: no transform is published')
            return None
        return TransformBroadcaster(self)


def transform_of(odometry: Motion, frame: str, child_frame: str) -> TransformStamped:
    """Return the transform between the frames of an odometry."""
    x, y, theta = odometry.pose
    message = TransformStamped(header=Header(frame_id=frame), child_frame_id=child_frame)
    set_time(message.header.stamp, odometry.stamp)
    message.transform.translation.x, message.transform.translation.y = x, y
    rotation = message.transform.rotation
    rotation.z, rotation.w = math.sin(theta / 2.0), math.cos(theta / 2.0)
    return message
