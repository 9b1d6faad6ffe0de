"""Elementary functions that take arrays and leave Python floats Python floats.

A formula written with them serves a batch of thousands of robots, and serves one robot ten times
faster than NumPy's scalars would: that matters where it runs for every message. Where a formula
overflows, Python raises or returns infinity, and NumPy warns and returns infinity or NaN: with
`evaluated` single and batched calls raise the same ValueError.

Functions of floats begin with one condition for all arguments, as checks would take longer than the
formula:

    single = type(v) is type(r) is float and r > 0.0 and isfinite(v + r)
    if not single:
        v, r = operand('v', v), operand('r', r, positive)
        single = agree(v=v, r=r)

A finite sum has finite terms. Arrays, other numbers, invalid arguments and sums that overflow are
checked one by one, which converts them or raises an error that names the argument.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from operator import mul
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.numerics.checks import FLOAT64, finite, floats, leading

TURN = 2.0 * math.pi
# Taylor coefficients of sinc_defect in the square of its argument, (-1)^n / (2n + 3)!
_DEFECT = [(-1.0) ** n / math.factorial(2 * n + 3) for n in range(9)]


def components(name: str, value: Any, size: int) -> list[Any]:
    """Split vectors along their last axis of `size` entries. A single vector is split into floats.

    Raises:
        ValueError: The last axis has another length, or there is none, or an entry is infinite, NaN
            or no number.
    """
    entries: list[Any]
    if type(value) is np.ndarray and value.dtype is FLOAT64 and value.shape == (size,):
        entries = value.tolist()
    elif type(value) is tuple and len(value) == size and _are_floats(value):
        entries = list(value)
    else:
        array = floats(name, value)
        if array.ndim == 0 or array.shape[-1] != size:
            raise ValueError(f'{name} must have shape (..., {size}), got {array.shape}')
        if array.ndim > 1:
            finite(name, array)
            return [array[..., index] for index in range(size)]
        entries = array.tolist()
    if not math.isfinite(sum(entries)) and not all_finite(entries):
        raise ValueError(f'{name} must be finite, got {entries}')
    return entries


def _are_floats(values: Iterable[Any]) -> bool:
    # Twice as fast as `all` of a generator.
    for value in values:  # noqa: SIM110
        if type(value) is not float:
            return False
    return True


def all_finite(values: Sequence[float]) -> bool:
    """Return whether all of these floats are finite."""
    return all(map(math.isfinite, values))


def operand(name: str, value: Any, check: Callable[[str, Any], None] = finite) -> Any:
    """Convert numbers to floats, and everything else to float arrays.

    Raises:
        ValueError: A number does not pass the check, or something is no number.
    """
    if type(value) is not float:
        value = floats(name, value)
        if value.ndim == 0:
            value = float(value)
    check(name, value)
    return value


def agree(**values: Any) -> bool:
    """Require arrays to broadcast. Return whether all arguments are floats.

    Raises:
        ValueError: They do not broadcast. The message names all of them.
    """
    if _are_floats(values.values()):
        return True
    leading(**{name: np.shape(value) for name, value in values.items()})
    return False


def evaluated(
    single: bool, names: str, formula: Callable[..., tuple[Any, ...]], *operands: Any
) -> tuple[Any, ...]:
    """Evaluate a formula whose results must be finite.

    Args:
        single: Whether all operands are floats.
        names: The arguments that the operands come from, for the error.
        formula: Function of the operands.
        operands: Finite floats, or arrays that broadcast.

    Returns:
        The results: floats, or arrays in the shape to which they broadcast.

    Raises:
        ValueError: A result overflows.
    """
    try:
        if single:
            results = formula(*operands)
            if math.isfinite(sum(results)) or all_finite(results):
                return results
        else:
            with np.errstate(all='ignore'):
                results = formula(*operands)
            if all(np.isfinite(result).all() for result in results):
                return alike(*results)
    except (OverflowError, ValueError, ZeroDivisionError):
        # Floats raise where arrays become infinity or NaN: in `x**2`, `math.sin(inf)`, and where a
        # divisor underflows to zero.
        pass
    raise ValueError(f'{names} must give a finite result, but it overflows')


def alike(*values: Any) -> tuple[Any, ...]:
    """Return floats as they are, and arrays in the shape to which they broadcast."""
    if set(map(type, values)) == {float} or len({np.shape(value) for value in values}) == 1:
        return values
    return tuple(map(np.array, np.broadcast_arrays(*values)))


def wrap(angle: Any) -> Any:
    """Wrap angles to (-pi, pi], exactly with respect to the double nearest to 2 pi."""
    if type(angle) is float:
        if -math.pi < angle <= math.pi:
            return angle
        # math.fmod raises where NumPy returns NaN.
        angle = math.fmod(angle, TURN) if math.isfinite(angle) else math.nan
    elif not np.abs(angle).max(initial=0.0) < 1.5 * TURN:
        # Nearer than that, one subtraction below is enough, exact and faster.
        angle = np.fmod(angle, TURN)
    return angle - TURN * (angle > np.pi) + TURN * (angle <= -np.pi)


def stack(*entries: Any) -> NDArray[np.float64]:
    """Stack entries that broadcast along a new last axis."""
    try:
        array: NDArray[np.float64] = np.array(entries, dtype=np.float64)
    except ValueError:  # of different shapes
        return np.stack(np.broadcast_arrays(*entries), axis=-1)
    return array if array.ndim == 1 else np.moveaxis(array, 0, -1)


def matrix(rows: int, columns: int, *entries: Any) -> NDArray[np.float64]:
    """Return matrices, shape (..., rows, columns), from their entries, row by row.

    Args:
        rows: Number of rows.
        columns: Number of columns.
        entries: Floats, or arrays that broadcast.
    """
    if _are_floats(entries):
        return np.array(entries).reshape(rows, columns)
    shapes = {entry.shape for entry in entries if type(entry) is not float}
    shape = shapes.pop() if len(shapes) == 1 else np.broadcast_shapes(*shapes)
    constants = any(type(entry) is float for entry in entries)
    matrices = (np.zeros if constants else np.empty)((*shape, rows, columns))
    for index, entry in enumerate(entries):
        if type(entry) is not float or entry != 0.0:
            matrices[..., index // columns, index % columns] = entry
    return matrices


def vector(*entries: Any) -> NDArray[np.float64]:
    """Return vectors, shape (..., n), from their n entries: floats, or arrays that broadcast."""
    if _are_floats(entries):
        return np.array(entries)
    return matrix(1, len(entries), *entries)[..., 0, :]


def from_rows(rows: Sequence[Sequence[Any]]) -> NDArray[np.float64]:
    """Return matrices, shape (..., m, n), from rows of entries that broadcast."""
    shape = np.broadcast_shapes(*[np.shape(entry) for row in rows for entry in row])
    matrices = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            matrices[..., i, j] = entry
    return matrices


def sin(x: Any) -> Any:
    """Sine (rad)."""
    return math.sin(x) if type(x) is float else np.sin(x)


def cos(x: Any) -> Any:
    """Cosine (rad)."""
    return math.cos(x) if type(x) is float else np.cos(x)


def atan2(y: Any, x: Any) -> Any:
    """Angle of the point (x, y) (rad)."""
    return math.atan2(y, x) if type(y) is type(x) is float else np.arctan2(y, x)


def hypot(x: Any, y: Any) -> Any:
    """Length of the vector (x, y)."""
    return sqrt(x * x + y * y)


def sinc(angle: Any) -> Any:
    """Compute sin(angle) / angle without a hole at zero (not NumPy's sin(pi x) / (pi x))."""
    # The result is exactly 1 for a tiny angle, which replaces zero.
    angle = angle + (angle == 0.0) * 1e-20
    return sin(angle) / angle


def sinc_defect(angle: Any) -> Any:
    """Compute (1 - sin(x)/x) / x^2, which is 1/6 at zero, to full precision."""
    square: Any = angle * angle
    series: Any = 0.0
    for coefficient in reversed(_DEFECT):
        series = series * square + coefficient
    far = where(square < 1.0, 1.0, angle)
    return where(square < 1.0, series, (1.0 - sin(far) / far) / (far * far))


def sqrt(x: Any) -> Any:
    """Square root of what is not negative."""
    return math.sqrt(x) if type(x) is float else np.sqrt(x)


def maximum(*values: Any) -> Any:
    """The largest one."""
    return max(values) if _are_floats(values) else functools.reduce(np.maximum, values)


def minimum(*values: Any) -> Any:
    """The smallest one."""
    return min(values) if _are_floats(values) else functools.reduce(np.minimum, values)


def where(condition: Any, x: Any, y: Any) -> Any:
    """Return x where the condition is true, otherwise y."""
    if type(condition) is bool:
        return x if condition else y
    return np.where(condition, x, y)


def product(A: Sequence[Sequence[Any]], B: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """Multiply two matrices that are lists of rows."""
    columns = list(zip(*B, strict=True))
    return [[sum(map(mul, row, column)) for column in columns] for row in A]


wrapped, arctan2 = wrap, atan2
