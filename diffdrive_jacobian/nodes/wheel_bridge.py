"""Body twists to wheel speeds through the inverse wheel Jacobian, for motors that know nothing else."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Twist, TwistStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.messages import conversion as messages
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.parameters.nodes import WheelBridgeParameters
from diffdrive_jacobian.ros.node import THROTTLE, ParameterizedNode
from diffdrive_jacobian.ros.watchdog import Watchdog
from diffdrive_jacobian.time_units import nanoseconds


class WheelBridge(ParameterizedNode[WheelBridgeParameters]):
    """Node wheel_bridge: `cmd_vel` in, `joint_command` out.

    Each command gives one message with the same stamp (an unstamped one: that of its receipt). When
    commands cease, one zero follows after the timeout.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create the bridge; `kwargs` as for `ParameterizedNode`."""
        super().__init__('wheel_bridge', WheelBridgeParameters, **kwargs)
        parameters = self.parameters
        self._message: JointState | Float64MultiArray = (
            JointState() if parameters.joint_command_type == 'JointState' else Float64MultiArray()
        )
        self._joint_command = self.advertise(type(self._message), 'joint_command')
        if parameters.enable_stamped_cmd_vel:
            self.subscribe(TwistStamped, 'cmd_vel', self._on_twist_stamped)
        else:
            self.subscribe(Twist, 'cmd_vel', self._on_twist)
        self._last = 0
        self._moving = False
        self._watchdog = Watchdog(self, self._on_silence)
        self._watchdog.start(nanoseconds(parameters.cmd_vel_timeout))
        self.announce('from and to', 'cmd_vel', 'joint_command')

    def _on_twist(self, message: Twist) -> None:
        self._take(message, None)

    def _on_twist_stamped(self, message: TwistStamped) -> None:
        self._take(message.twist, message.header.stamp)

    def _take(self, twist: Twist, time: Time | None) -> None:
        now = self.now()
        # After time went back the last command's instant means nothing any more.
        last = self._last if self._last <= now else 0
        try:
            if now == 0:
                raise MessageError('simulated time has not begun, nothing came on /clock')
            v, omega = messages.from_twist(twist)
            stamp = 0 if time is None else messages.from_time(time)
            timeout = nanoseconds(self.parameters.cmd_vel_timeout)
            self._last = messages.command_instant(stamp, now, last, timeout)
        except MessageError as error:
            self.get_logger().warning(f'command dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        self._watchdog.feed(now)
        self._publish(self._wheel_speeds(v, omega), self._last)

    def _wheel_speeds(self, v: float, omega: float) -> tuple[Any, Any]:
        """Give `(omega_R, omega_L)` of calibrated wheels, within their limit."""
        parameters = self.parameters
        r, L = parameters.wheel_radius, parameters.wheel_separation
        L *= parameters.wheel_separation_multiplier
        right, left = body_to_wheel(v, omega, r, L)
        right /= parameters.right_wheel_radius_multiplier
        left /= parameters.left_wheel_radius_multiplier
        excess = max(1.0, max(abs(right), abs(left)) / parameters.fastest_wheel)
        return right / excess, left / excess

    def _publish(self, speeds: tuple[Any, Any], stamp: int) -> None:
        self._moving = speeds != (0.0, 0.0)
        if isinstance(self._message, JointState):
            self._message.name = [self.parameters.left_wheel_name, self.parameters.right_wheel_name]
            messages.set_joint_state(self._message, stamp, speeds)
        else:
            self._message.data = [speeds[1], speeds[0]]
        self._joint_command.publish(self._message)

    def _on_silence(self) -> None:
        if self._moving:
            self._publish((0.0, 0.0), self.now())
            self.log_event_warning(
                'silence',
                f'no command on {self.resolve_topic_name("cmd_vel")} '
                f'for {self.parameters.cmd_vel_timeout:g} s: the wheels are stopped',
            )

    def stop(self, why: str) -> None:
        """Stop the wheels, if they turn."""
        if self._moving:
            self._publish((0.0, 0.0), self.now())
            self.get_logger().info(f'the wheels are stopped: {why}')
            self.flush(self._joint_command)

    def parameters_changed(self, previous: WheelBridgeParameters) -> None:
        """Follow a new timeout; the rest counts from the next command on."""
        if self.parameters.cmd_vel_timeout != previous.cmd_vel_timeout:
            self._watchdog.start(nanoseconds(self.parameters.cmd_vel_timeout))
