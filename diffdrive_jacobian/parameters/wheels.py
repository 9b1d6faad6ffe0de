"""Whether two nodes have the same wheels: one computes their speeds, the other one drives by them."""

from __future__ import annotations

WHEELS = ('wheel_radius', 'wheel_separation')
"""Parameters with the dimensions for which wheel speeds are computed, and with which they are driven."""
SAME_WHEELS = 'give both nodes the same dimensions, as by the same --robot or --params-file'
"""What to do about that."""


def different_wheels(computed: tuple[float, ...], name: str, driven: tuple[float, ...]) -> str:
    """Return what a node does whose wheels differ from those for which its speeds are computed.

    Empty: they are the same.

    Args:
        computed: The values of WHEELS for which the speeds are computed (m).
        name: Name of the node that drives by the speeds.
        driven: Its values of WHEELS (m).
    """
    differences = [
        f'{what} {there:g} m instead of {here:g} m'
        for what, here, there in zip(WHEELS, computed, driven, strict=True)
        if here != there
    ]
    if not differences:
        return ''
    (r, L), (their_r, their_L) = computed, driven
    return (
        f'{name} has {" and ".join(differences)}, for which its wheel speeds are computed: it drives '
        f'{their_r / r:.3g} times and turns {their_r / r * L / their_L:.3g} times as fast as commanded'
    )
