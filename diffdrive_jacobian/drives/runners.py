"""The runners of a drive, in real time and in simulated time, for its whole duration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from typing import TYPE_CHECKING

from diffdrive_jacobian.errors import DiffdriveError, UserError
from diffdrive_jacobian.ros.runner import Runner, discovery_off, ros_context, running

if TYPE_CHECKING:
    from diffdrive_jacobian.lockstep.runner import LockstepRunner

NAME = 'drive_to'
"""Name of the node that sends the goals."""


class DriveError(DiffdriveError):
    """A drive in simulated time was aborted. The message says why."""


@contextmanager
def in_real_time(ros_arguments: Sequence[str] = (), *, isolated: bool = True) -> Iterator[Runner]:
    """Create a runner of nodes in real time, and close it at the end.

    Args:
        ros_arguments: ROS arguments of all nodes.
        isolated: Whether no other process can communicate with the nodes.

    Raises:
        UserError: The ROS arguments are invalid.
    """
    with (
        discovery_off() if isolated else nullcontext(),
        ros_context([NAME, *ros_arguments]) as context,
        running(context, isolated=isolated) as runner,
    ):
        yield runner


@contextmanager
def in_lockstep(ros_arguments: Sequence[str] = ()) -> Iterator[LockstepRunner]:
    """Create a runner of nodes in simulated time, and close it at the end.

    Args:
        ros_arguments: ROS arguments of all nodes.

    Raises:
        UserError: The ROS arguments are invalid.
        DriveError: A callback blocks, or simulated time cannot advance for another reason.
    """
    # Slow to import.
    from diffdrive_jacobian.lockstep._errors import LockstepError
    from diffdrive_jacobian.lockstep.runner import running_in_lockstep

    with ExitStack() as stack:
        try:
            runner = stack.enter_context(running_in_lockstep(ros_arguments))
        except LockstepError as error:
            raise UserError(str(error)) from error
        try:
            yield runner
        except LockstepError as error:
            raise DriveError(str(error)) from error
