"""The node wheel_bridge: wheel speeds from body twists, by the inverse wheel Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from diffdrive_jacobian.kinematics.diff_drive import body_to_wheel
from diffdrive_jacobian.messages.codecs import (
    JOINT_STATE,
    TWIST,
    TWIST_STAMPED,
    WHEEL_ARRAY,
    WheelArray,
    Wheels,
)
from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.nodes.command_time import command_time
from diffdrive_jacobian.parameters.wheel_bridge import WheelBridgeParameters
from diffdrive_jacobian.ros.graph_faults import ALTERNATION_PATIENCE, alternating_commands, unread
from diffdrive_jacobian.ros.lasting import Interleaving
from diffdrive_jacobian.ros.node import NO_CLOCK, THROTTLE, ParameterizedNode
from diffdrive_jacobian.ros.watchdog import Watchdog
from diffdrive_jacobian.time_units import nanoseconds

__all__ = ['WheelBridge']


class WheelBridge(ParameterizedNode[WheelBridgeParameters]):
    """Node that subscribes to `cmd_vel` and publishes `joint_command`.

    It publishes one message for each command, with its stamp, or the time of receipt if it has none. If
    no command is received for the timeout, it publishes one zero.
    """

    def __init__(self, **kwargs: Any) -> None:
        """Create the bridge. `kwargs` as for `ParameterizedNode`."""
        super().__init__('wheel_bridge', WheelBridgeParameters, **kwargs)
        parameters = self.parameters
        as_joints = parameters.joint_command_type == 'JointState'
        self._joint_command = self.advertise(
            JointState if as_joints else Float64MultiArray, 'joint_command'
        )
        self._configure()
        self._commands = numbers = Interleaving()
        stamped = parameters.enable_stamped_cmd_vel
        kind, self._codec = (TwistStamped, TWIST_STAMPED) if stamped else (Twist, TWIST)
        self.subscribe(kind, 'cmd_vel', self._on_command, codec=self._codec, numbers=numbers)
        self.watch(unread(self._joint_command, 'joint_command'))
        self.watch(alternating_commands(self, 'cmd_vel', numbers), ALTERNATION_PATIENCE)
        self._last = 0
        self._moving = False
        self._watchdog = Watchdog(self, self._on_silence)
        self._watchdog.start(self._timeout)
        self.announce(subscribed=['cmd_vel'], publishing=['joint_command'])

    def _on_command(self, *fields: Any) -> None:
        now = self.now()
        # The time of the last command is meaningless after time went back.
        last = self._last if self._last <= now else 0
        try:
            if now == 0:
                raise MessageError(NO_CLOCK)
            (v, omega), stamp = self._codec.value(*fields)
            self._last = command_time(stamp, now, last, self._timeout)
        except MessageError as error:
            self.get_logger().warning(f'command dropped: {error}', throttle_duration_sec=THROTTLE)
            return
        self._watchdog.feed(now)
        if v or omega:
            self._commands.count()
            self.warn_of_integers('a command on cmd_vel', v, omega)
        self._publish(self._wheel_speeds(v, omega), self._last)

    def _wheel_speeds(self, v: float, omega: float) -> tuple[Any, Any]:
        """Return `(omega_R, omega_L)` of the calibrated wheels, within their limit (rad/s)."""
        parameters = self.parameters
        L = parameters.wheel_separation * parameters.wheel_separation_multiplier
        right, left = body_to_wheel.formula(v, omega, parameters.wheel_radius, L)
        right /= parameters.right_wheel_radius_multiplier
        left /= parameters.left_wheel_radius_multiplier
        excess = max(1.0, max(abs(right), abs(left)) / parameters.wheel_speed_limit)
        return right / excess, left / excess

    def _publish(self, speeds: tuple[Any, Any], stamp: int) -> None:
        self._moving = speeds != (0.0, 0.0)
        self._joint_command.publish(self._serialized(speeds, stamp))

    def _on_silence(self) -> None:
        if self._moving:
            self._publish((0.0, 0.0), self.now())
            self.log_event_warning(
                'silence',
                f'no command on {self.resolve_topic_name("cmd_vel")} '
                f'for {self.parameters.cmd_vel_timeout:g} s: the wheels are stopped',
            )

    def stop(self, why: str) -> None:
        """Publish zero wheel speeds, unless they are zero."""
        if self._moving:
            self._publish((0.0, 0.0), self.now())
            self.get_logger().info(f'the wheels are stopped: {why}')
            self.flush(self._joint_command)

    def parameters_changed(self, previous: WheelBridgeParameters) -> None:
        """Change the timeout. Other parameters apply from the next command on."""
        self._configure()
        if self.parameters.cmd_vel_timeout != previous.cmd_vel_timeout:
            self._watchdog.change_timeout(self._timeout)

    def _configure(self) -> None:
        """Compute from the parameters what every command needs."""
        parameters = self.parameters
        self._timeout = nanoseconds(parameters.cmd_vel_timeout)
        self._serialized: Callable[[tuple[float, float], int], bytes]
        speeds, names = [0.0, 0.0], parameters.wheel_names
        if self._joint_command.msg_type is JointState:
            joints = JOINT_STATE.writer(JointState(name=[*names], velocity=speeds))
            self._serialized = lambda speeds, stamp: joints(Wheels.of(stamp, names, speeds))
        else:
            array = WHEEL_ARRAY.writer(Float64MultiArray(data=speeds))
            self._serialized = lambda speeds, _: array(WheelArray.of(speeds))
