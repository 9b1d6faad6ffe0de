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

"""Whether two nodes have the same wheels: one computes their speeds, the other one drives by them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

WHEELS = (
    'wheel_radius',
    'right_wheel_radius_multiplier',
    'left_wheel_radius_multiplier',
    'wheel_separation',
    'wheel_separation_multiplier',
)
"""Parameters with the dimensions for which wheel speeds are computed, and with which they are driven."""
SAME_WHEELS = 'give both nodes the same dimensions, as by the same --robot or --params-file'
"""What to do about other ones."""


class Dimensions(NamedTuple):
    """Dimensions of the wheels, the multipliers included (m)."""

    right_radius: float
    left_radius: float
    separation: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Dimensions:
        """Return those of the values of WHEELS."""
        named = dict(zip(WHEELS, values, strict=True))
        radius = named['wheel_radius']
        return cls(
            named['right_wheel_radius_multiplier'] * radius,
            named['left_wheel_radius_multiplier'] * radius,
            named['wheel_separation_multiplier'] * named['wheel_separation'],
        )


def different_wheels(computed: Dimensions, name: str, driven: Dimensions) -> str:
    """Return what a node does whose wheels differ from those for which its speeds are computed.

    Empty: they are the same.

    Args:
        computed: The dimensions for which the speeds are computed.
        name: Name of the node that drives by the speeds.
        driven: Its dimensions.
    """
    alike = all(one.right_radius == one.left_radius for one in (computed, driven))
    names = 'wheel_radius' if alike else 'right wheel radius', 'left wheel radius', 'wheel_separation'
    differences = [
        f'{what} {there:g} m instead of {here:g} m'
        for what, here, there in zip(names, computed, driven, strict=True)
        if not math.isclose(here, there) and not (alike and what == 'left wheel radius')
    ]
    if not differences:
        return ''
    right, left, separation = (there / here for here, there in zip(computed, driven, strict=True))
    # Of the speeds of a straight line and of a turn in place.
    curve = '' if math.isclose(right, left) else ', straight lines on a curve,'
    return (
        f'{name} has {" and ".join(differences)}, for which its wheel speeds are computed: it drives '
        f'{(right + left) / 2.0:.3g} times{curve} and turns {(right + left) / 2.0 / separation:.3g} '
        'times as fast as commanded'
    )
