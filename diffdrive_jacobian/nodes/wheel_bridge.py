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

"""The node wheel_bridge: wheel speeds from body twists, by the inverse wheel Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from diffdrive_jacobian.messages.codecs import (
    JOINT_STATE,
    TWIST,
    TWIST_STAMPED,
    WHEEL_ARRAY,
    Command,
    WheelArray,
    Wheels,
)
from diffdrive_jacobian.messages.conversion import MessageError, command_time
from diffdrive_jacobian.messages.topic_faults import UNREAD
from diffdrive_jacobian.nodes.same_wheels import SameWheels
from diffdrive_jacobian.parameters.wheel_bridge import WheelBridgeParameters
from diffdrive_jacobian.parameters.wheels import SAME_WHEELS
from diffdrive_jacobian.ros.graph_faults import Interleaving, topic_check
from diffdrive_jacobian.ros.node import NO_CLOCK, ParameterizedNode
from diffdrive_jacobian.ros.rclpy_internals import restart_timer
from diffdrive_jacobian.ros.watchdog import Watchdog
from diffdrive_jacobian.simulation.actuators import ramp
from diffdrive_jacobian.simulation.robot import STANDSTILL
from diffdrive_jacobian.simulation.speeds import Profile
from diffdrive_jacobian.time_units import nanoseconds

__all__ = ['WheelBridge']


class WheelBridge(ParameterizedNode[WheelBridgeParameters]):
    """Node that subscribes to `cmd_vel` and publishes `joint_command`.

    It publishes one message for each command, with its stamp, or the time of receipt if it has none. If
    no command is received for the timeout, it publishes one zero.

    With limits of the acceleration, each message has the speeds of its time. Further ones follow at
    `publish_rate` until the commanded speeds are reached.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create the bridge. `kwargs` as for `ParameterizedNode`."""
        super().__init__('wheel_bridge', WheelBridgeParameters(), **kwargs)
        parameters = self.parameters
        as_joints = parameters.joint_command_type == 'JointState'
        self._joint_command = self.advertise(
            JointState if as_joints else Float64MultiArray, 'joint_command'
        )
        self._configure()
        self._same_wheels: SameWheels | None = SameWheels(
            self,
            self._joint_command,
            lambda: self.parameters.dimensions,
            lambda found: self.get_logger().warning(f'{found}; {SAME_WHEELS}'),
        )
        self._numbers = Interleaving()
        stamped = parameters.enable_stamped_cmd_vel
        kind, codec = (TwistStamped, TWIST_STAMPED) if stamped else (Twist, TWIST)
        self.subscribe(
            kind,
            'cmd_vel',
            self._on_command,
            codec=codec,
            called='command',
            numbers=self._numbers,
        )
        readers = self._joint_command.get_subscription_count
        self.watch(topic_check(self, UNREAD, 'joint_command', readers))
        self._last = 0
        self._twist = self._target = STANDSTILL
        # From the last command on, with limits of the acceleration.
        self._profile: Profile | None = None
        self._timer = self.create_timer(1.0, self._on_tick, autostart=False)
        self._watchdog = Watchdog(self, self._on_silence)
        self._watchdog.start(self._timeout)
        self.announce(subscribed=['cmd_vel'], publishing=['joint_command'])

    def _on_command(self, command: Command) -> None:
        now = self.now()
        if now == 0:
            raise MessageError(NO_CLOCK)
        (v, omega), stamp = command
        # The time of the last command is meaningless after time went back.
        last = self._last if self._last <= now else 0
        self._last = command_time(stamp, now, last, self._timeout)
        self._watchdog.feed(now)
        if self._same_wheels is not None and self._same_wheels.advance():
            self._same_wheels = None
        if v or omega:
            self._numbers.count()
            self.warn_of_integers('a command on cmd_vel', v, omega)
        self._follow((v, omega), self._last, now)

    def _follow(self, command: tuple[float, float], stamp: int, now: int) -> None:
        """Publish the speeds of a twist with a stamp, or start to approach them within the limits."""
        self._target = target = self._model.limited(command)
        if self._acceleration.unlimited:
            self._profile = None
            self._publish(target, stamp)
            return
        profile, start = self._profile, self._twist
        if profile is not None and profile.start <= now:
            start = profile.twist(profile.seconds(now))
        self._profile = Profile(now, [*ramp(start, target, self._acceleration, self._model)])
        restart_timer(self._timer, self._period)
        self._approach(self._profile, now)

    def _approach(self, profile: Profile, now: int) -> None:
        """Publish the present speeds."""
        self._publish(profile.twist(profile.seconds(now)), now)
        if now >= profile.settled_at:
            self._timer.cancel()

    def _on_tick(self) -> None:
        now, profile = self.now(), self._profile
        if profile is None:
            self._timer.cancel()
        elif now < profile.start:
            # Time went back.
            self._follow(self._target, now, now)
        else:
            self._approach(profile, now)

    def _publish(self, twist: tuple[float, float], stamp: int) -> None:
        self._twist = twist
        self._joint_command.publish(self._write_speeds(self._model.wheel_speeds(*twist), stamp))

    @property
    def _moving(self) -> bool:
        return self._twist != STANDSTILL or self._target != STANDSTILL

    def _on_silence(self) -> None:
        if self._moving:
            self._last = now = self.now()
            self._follow(STANDSTILL, now, now)
            self.log_event_warning(
                'silence',
                f'no command on {self.resolve_topic_name("cmd_vel")} '
                f'for {self.parameters.cmd_vel_timeout:g} s: the wheels are stopped',
            )

    def stop(self, why: str) -> None:
        """Publish zero wheel speeds, unless they are zero. Nobody is left to approach them."""
        if self._moving:
            self._timer.cancel()
            self._target, self._profile = STANDSTILL, None
            self._publish(STANDSTILL, self.now())
            self.get_logger().info(f'the wheels are stopped: {why}')
            self.flush(self._joint_command)

    def parameters_changed(self, previous: WheelBridgeParameters) -> None:
        """Change the timeout. Dimensions apply to what is published next, limits to the next command."""
        self._configure()
        if self.parameters.cmd_vel_timeout != previous.cmd_vel_timeout:
            self._watchdog.change_timeout(self._timeout)

    def _configure(self) -> None:
        """Compute from the parameters what every command needs."""
        parameters = self.parameters
        self._timeout = nanoseconds(parameters.cmd_vel_timeout)
        self._period = nanoseconds(1.0 / parameters.publish_rate)
        self._model = parameters.model()
        self._acceleration = parameters.acceleration_limits()
        self._write_speeds: Callable[[tuple[float, float], int], bytes]
        speeds, names = [0.0, 0.0], parameters.wheel_names
        if self._joint_command.msg_type is JointState:
            joints = JOINT_STATE.writer(JointState(name=[*names], velocity=speeds))
            self._write_speeds = lambda speeds, stamp: joints(Wheels.of(stamp, names, speeds))
        else:
            array = WHEEL_ARRAY.writer(Float64MultiArray(data=speeds))
            self._write_speeds = lambda speeds, _: array(WheelArray.of(speeds))
