"""A batch of closed loops: its arguments, checked and flattened, and its outcomes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control.controller import Controller, Law
from diffdrive_jacobian.control.waypoints import Arrival
from diffdrive_jacobian.kinematics.saturation import VelocityLimits
from diffdrive_jacobian.numerics.checks import (
    array,
    floats,
    function,
    leading,
    number,
    positive,
)
from diffdrive_jacobian.numerics.fields import instance, optional
from diffdrive_jacobian.simulation.actuators import Actuators

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]
MAX_STEPS = 1e12
"""Largest number of samples of a loop."""


class Outcomes(NamedTuple):
    """Outcome of each robot; every field has the shape of the batch.

    Attributes:
        arrived: Whether it arrived in time.
        time: Time of arrival; NaN: it did not arrive (s). Robots that take time to stop roll on.
        path_length: Length of the path of the axle centre, forwards and backwards (m).
        control_cost: Integral of the squares of both wheel speeds over time (rad^2/s).
        overshoot: Largest distance beyond the goal, along the line from start to goal (m).
        pose: Last pose, at rest if it arrived, shape (..., 3).
    """

    arrived: Mask
    time: Array
    path_length: Array
    control_cost: Array
    overshoot: Array
    pose: Array


def _followed(name: str, value: object) -> Actuators | None:
    """Require actuators whose motors are fast enough; None: at once."""
    actuators: Actuators | None = optional(partial(instance, wanted=Actuators))(name, value)
    if actuators is None:
        return None
    if min(actuators.max_right_speed, actuators.max_left_speed) < math.inf:
        raise ValueError(
            f'{name} must have no max_right_speed or max_left_speed: in batches no motor saturates'
        )
    return None if actuators.immediate else actuators


@dataclass(frozen=True, kw_only=True)
class Batch:
    """A batch. Values that are equal for all robots are numbers, others have a first axis of robots."""

    law: Law
    equation: Law | None
    """The law of components without checks, where it is a `formula`."""
    state: tuple[float, ...]
    """What the law remembers at the start, as of `Controller`."""
    starts: Array
    goals: Array
    gains: tuple[Any, ...]
    rate: float
    steps: int
    arrival: Arrival
    turning_gain: Any
    limits: VelocityLimits
    r: Any
    L: Any
    actuators: Actuators | None
    """None: the robots follow commands at once."""
    shape: tuple[int, ...]
    """Shape of the batch before it was flattened."""

    @classmethod
    def of(
        cls,
        law: Law | Controller,
        starts: ArrayLike,
        goals: ArrayLike,
        gains: tuple[ArrayLike, ...],
        rate: float,
        duration: float,
        arrival: Arrival | None,
        turning_gain: ArrayLike,
        limits: VelocityLimits,
        r: ArrayLike,
        L: ArrayLike,
        actuators: Actuators | None,
    ) -> Batch:
        """Check the arguments and flatten the batch."""
        arrival = Arrival() if arrival is None else arrival
        state: tuple[float, ...] = ()
        if isinstance(law, Controller):
            state, law = law.state, law.law
        else:
            function('law', law)
        instance('arrival', arrival, Arrival)
        instance('limits', limits, VelocityLimits)
        actuators = _followed('actuators', actuators)
        starts, goals = array('starts', starts, 3), array('goals', goals, 'm')
        if goals.shape[-1] not in (2, 3) or (arrival.use_heading and goals.shape[-1] != 3):
            wanted = '(..., 3)' if arrival.use_heading else '(..., 2) or (..., 3)'
            raise ValueError(f'goals must have shape {wanted}, got {goals.shape}')
        rate = number('rate', rate, positive)
        duration = number('duration', duration, positive)
        if not duration * rate < MAX_STEPS:
            raise ValueError(
                f'duration must be below {MAX_STEPS / rate:g} s at that rate, got {duration:g}'
            )
        columns = {f'gain {index}': array(f'gain {index}', gain) for index, gain in enumerate(gains)}
        columns['turning_gain'] = array('turning_gain', turning_gain)
        columns['offset'] = floats('offset', arrival.offset)
        columns.update(r=floats('r', r), L=floats('L', L))
        positive('r', columns['r'])
        positive('L', columns['L'])
        columns.update(
            zip(limits.names(), (floats('limits', limit) for limit in limits.all()), strict=True)
        )
        shape = leading(
            starts=starts.shape[:-1],
            goals=goals.shape[:-1],
            **{name: value.shape for name, value in columns.items()},
        )
        flat = {
            name: float(value) if value.ndim == 0 else np.broadcast_to(value, shape).reshape(-1)
            for name, value in columns.items()
        }
        return cls(
            law=law,
            equation=getattr(law, 'formula', None),
            state=state,
            starts=np.broadcast_to(starts, (*shape, 3)).reshape(-1, 3),
            goals=np.broadcast_to(goals, (*shape, goals.shape[-1])).reshape(-1, goals.shape[-1]),
            gains=tuple(flat[f'gain {index}'] for index in range(len(gains))),
            rate=rate,
            steps=math.ceil(duration * rate - 1e-9),
            arrival=replace(arrival, offset=flat['offset']),
            turning_gain=flat['turning_gain'],
            limits=VelocityLimits(**{name: flat[name] for name in limits.names()}),
            r=flat['r'],
            L=flat['L'],
            actuators=actuators,
            shape=shape,
        )

    @property
    def size(self) -> int:
        """Number of robots."""
        return len(self.starts)

    @property
    def remembered(self) -> dict[str, Any]:
        """Arguments of a law with a state, at the start."""
        return {'state': np.array(self.state), 'dt': 0.0} if self.state else {}

    def some(self, rows: Any) -> Batch:
        """Return the batch of some of the robots, each coordinate contiguous in memory."""

        def pick(value: Any) -> Any:
            return value if isinstance(value, float) else value[rows]

        return replace(
            self,
            starts=np.array(self.starts[rows].T).T,
            goals=np.array(self.goals[rows].T).T,
            gains=tuple(map(pick, self.gains)),
            arrival=replace(self.arrival, offset=pick(self.arrival.offset)),
            turning_gain=pick(self.turning_gain),
            limits=VelocityLimits(
                **dict(zip(self.limits.names(), map(pick, self.limits.all()), strict=True))
            ),
            r=pick(self.r),
            L=pick(self.L),
        )
