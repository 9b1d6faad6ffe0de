"""When a velocity command takes effect."""

from __future__ import annotations

from diffdrive_jacobian.messages.conversion import MessageError
from diffdrive_jacobian.time_units import seconds


def command_time(stamp: int, now: int, last: int, timeout: int) -> int:
    """Return the time at which a command takes effect (ns).

    A command with a stamp takes effect at its stamp, one without at its receipt.

    Args:
        stamp: Stamp of the command (ns); 0: none.
        now: Current time (ns).
        last: Time at which the last command took effect (ns).
        timeout: Largest age of a command (ns); 0: no limit.

    Raises:
        MessageError: The stamp is in the future, older than the last command or older than the timeout.
    """
    if stamp == 0:
        return now
    if stamp > now:
        raise MessageError(f'its stamp is {seconds(stamp - now):.6f} s in the future')
    if timeout and now - stamp > timeout:
        raise MessageError(
            f'its stamp is {seconds(now - stamp):.6f} s old, more than the timeout of '
            f'{seconds(timeout):g} s'
        )
    if stamp < last:
        raise MessageError(
            f'its stamp is {seconds(last - stamp):.6f} s older than the last command, stop, reset of '
            'the pose or change of parameters'
        )
    return stamp
