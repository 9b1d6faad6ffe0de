"""A batch of closed loops: its arguments, checked and flattened, and what becomes of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diffdrive_jacobian.control.arrival import Arrival
from diffdrive_jacobian.control.saturation import VelocityLimits
from diffdrive_jacobian.kinematics._checks import (
    array,
    floats,
    function,
    instance,
    leading,
    number,
    positive,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]
Law = Callable[..., tuple[Any, Any]]
"""`law(poses, goals, *gains)` with shapes (k, 3), (k, 2 or 3) and for each gain () or (k,); gives `(v,
omega)`. `go_to_goal`, `offset_point` and `go_to_pose` are such laws."""
MAX_STEPS = 1e12


class Outcomes(NamedTuple):
    """What became of each robot; every field has the shape of the batch.

    Attributes:
        arrived: Whether it arrived in time.
        time: When it arrived; NaN: it did not (s).
        path_length: Way of the axle centre, backwards too (m).
        effort: Integral of the squares of both wheel speeds over time (rad^2/s).
        overshoot: How far it went beyond the goal, along the line from start to goal (m).
        pose: Where it was at the end, shape (..., 3).
    """

    arrived: Mask
    time: Array
    path_length: Array
    effort: Array
    overshoot: Array
    pose: Array


@dataclass(frozen=True, kw_only=True)
class Batch:
    """The whole batch: what is the same for all as a number, the rest with a first axis of robots."""

    law: Law
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
    shape: tuple[int, ...]
    """Of the batch, before it was flattened."""

    @classmethod
    def of(
        cls,
        law: Law,
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
    ) -> Batch:
        """Check the arguments and flatten the batch."""
        arrival = Arrival() if arrival is None else arrival
        function('law', law)
        instance('arrival', arrival, Arrival)
        instance('limits', limits, VelocityLimits)
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
            shape=shape,
        )

    @property
    def size(self) -> int:
        """How many robots there are."""
        return len(self.starts)

    def some(self, rows: Any) -> Batch:
        """Give some of the robots, their coordinates each in one piece of memory."""

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
