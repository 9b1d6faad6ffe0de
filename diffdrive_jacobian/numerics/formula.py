"""Equations as functions of arrays: the body is the equation, a decorator checks what comes in.

    @formula('() -> (3,2)')
    def unicycle_jacobian(theta):
        return [[cos(theta), 0],
                [sin(theta), 0],
                [0,          1]]

The signature is that of NumPy's generalized universal functions, without the leading axes: `()` is a
number, `(3)` a vector of three entries, `(3,2)` a matrix, and a letter a size that the arguments have in
common. The leading axes of all arguments broadcast, and the results have them.

The body is written for one robot, in components: a number is a float, a vector a list of floats. For a
batch the same body is evaluated once, with an array of the shape of the batch in place of each float, so
it uses the functions of `numerics.elementary`. Results are numbers, lists of numbers, or matrices as
lists of rows. If an argument is a matrix, all arguments are arrays, with their entries first: vectors
have the shape (n, ...), matrices (m, n, ...), and `(a, b), (c, d) = J`. Results may be such arrays, too.

Bad arguments raise a ValueError that names the argument, and so does a result that overflows. The body
without these checks is `formula` of the decorated function: it is for callers whose numbers are checked.
The same body for floats alone is `floats`: it is for what runs for every message.
"""

from __future__ import annotations

import functools
import inspect
import math
import re
from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, TypeAlias, TypeVar, cast, overload

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.numerics.checks import FLOAT64, finite, leading, shaped
from diffdrive_jacobian.numerics.elementary import for_floats

__all__ = ['formula']

Array: TypeAlias = NDArray[np.float64]
Number: TypeAlias = Any
"""A float, or an array with one entry for each robot of a batch."""
Vector: TypeAlias = Any
"""The entries of a vector, or what the caller has given for it."""
Entries: TypeAlias = list[Number]
"""A vector as a result."""
Rows: TypeAlias = list[list[Number]]
"""A matrix as a result."""
Shape: TypeAlias = tuple[int | str, ...]
"""Sizes of the axes; a letter is any size."""
Check: TypeAlias = Callable[[str, Any], None]
"""Raises ValueError with the name of the argument if a value is not allowed."""

P = ParamSpec('P')
R = TypeVar('R', covariant=True)


class Formula(Protocol[P, R]):
    """An equation whose arguments are checked."""

    __name__: str
    formula: Callable[..., Any]
    """The equation without checks."""
    floats: Callable[..., Any]
    """The equation without checks, for floats."""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Check the arguments and evaluate the equation."""


class _Decorator(Protocol):
    @overload
    def __call__(self, body: Callable[P, Rows], /) -> Formula[P, Array]: ...
    @overload
    def __call__(self, body: Callable[P, Entries], /) -> Formula[P, Array]: ...
    @overload
    def __call__(self, body: Callable[P, R], /) -> Formula[P, R]: ...


def formula(signature: str, **checks: Check) -> _Decorator:
    """Return the decorator of an equation.

    Args:
        signature: Shapes of the arguments and the results, such as `(3),() -> (),()`. An argument that
            is None by default may be None.
        checks: What is required of an argument, by its name. All must be finite.
    """
    inputs, outputs = (_shapes(side) for side in signature.split('->'))
    whole, several = any(len(shape) > 1 for shape in inputs), len(outputs) > 1

    def decorate(body: Callable[..., Any]) -> Any:
        described = inspect.signature(body)
        names = tuple(described.parameters)
        optional = tuple(described.parameters[name].default is None for name in names)
        tests = [checks.get(name, finite) for name in names]
        kinds = [parameter.kind for parameter in described.parameters.values()]
        positional = len(names) - kinds.count(inspect.Parameter.KEYWORD_ONLY)
        restrictions = [
            (index, name, checks[name]) for index, name in enumerate(names) if name in checks
        ]
        given = f'{", ".join(names[:-1])} and {names[-1]}' if names[1:] else names[0]

        def evaluated(values: list[Any]) -> Any:
            if positional == len(names):
                return body(*values)
            return body(**dict(zip(names, values, strict=True)))

        @functools.wraps(body)
        def checked(*args: Any, **kwargs: Any) -> Any:
            missing = optional[len(args) :]
            if not kwargs and all(missing) and len(args) <= positional:
                # `bind` takes longer than most equations.
                args += (None,) * len(missing)
            else:
                try:
                    bound = described.bind(*args, **kwargs)
                except TypeError as error:
                    raise TypeError(f'{body.__name__}: {error}; it takes {given}') from None
                bound.apply_defaults()
                args = tuple(bound.arguments.values())
            batch: tuple[int, ...] = ()
            values = None if whole else _single(args, inputs, optional)
            if values is None:
                values, batch = _several(args, inputs, names, tests, optional)
                if whole:
                    values = [
                        entries_first(value, len(shape), len(batch))
                        for value, shape in zip(values, inputs, strict=True)
                    ]
                else:
                    values = list(map(_components, values, inputs))
            else:
                for index, name, check in restrictions:
                    if values[index] is not None:
                        check(name, values[index])
            try:
                if batch or whole:
                    with np.errstate(all='ignore'):
                        results = evaluated(values)
                else:
                    results = evaluated(values)
                if several:
                    return tuple([_packed(*one, batch) for one in zip(results, outputs, strict=True)])
                return _packed(results, outputs[0], batch)
            except np.linalg.LinAlgError:
                raise
            except (ArithmeticError, ValueError):
                # Floats raise these where arrays become infinite: `x**2`, `sin(inf)`, `1 / 0`.
                raise ValueError(f'{given} must give a finite result, but it overflows') from None

        def first(*args: Any, **kwargs: Any) -> Any:
            # Not before: the body may call what is defined after it.
            checked.floats = for_floats(body)  # type: ignore[attr-defined]
            return checked.floats(*args, **kwargs)  # type: ignore[attr-defined]

        checked.formula, checked.floats = body, first  # type: ignore[attr-defined]
        return checked

    return cast('_Decorator', decorate)


def _shapes(side: str) -> list[Shape]:
    """Return the shapes in one side of a signature."""
    return [
        tuple(int(size) if size.isdigit() else size for size in re.findall(r'\w+', shape))
        for shape in re.findall(r'\(([^)]*)\)', side)
    ]


def _single(args: tuple[Any, ...], shapes: list[Shape], optional: tuple[bool, ...]) -> list[Any] | None:
    """Return floats and vectors of one robot as floats and lists; None if anything is something else."""
    values: list[Any] = []
    total = 0.0
    for value, shape, may_miss in zip(args, shapes, optional, strict=True):
        if isinstance(value, float) and not shape:
            # NumPy's are floats, too.
            value = float(value)
            total += value
        elif type(value) is np.ndarray and value.dtype is FLOAT64 and value.shape == shape and shape:
            value = value.tolist()
            total += sum(value)
        elif value is not None or not may_miss:
            return None
        values.append(value)
    # A finite sum has finite terms.
    return values if math.isfinite(total) else None


def _several(
    args: tuple[Any, ...],
    shapes: list[Shape],
    names: tuple[str, ...],
    tests: list[Check],
    optional: tuple[bool, ...],
) -> tuple[list[Any], tuple[int, ...]]:
    """Return all arguments as arrays, and the leading axes to which they broadcast."""
    values: list[Any] = []
    leads: dict[str, tuple[int, ...]] = {}
    sizes: dict[int | str, int] = {}
    for value, shape, name, test, may_miss in zip(args, shapes, names, tests, optional, strict=True):
        if value is not None or not may_miss:
            value = shaped(name, value, *(sizes.get(size, size) for size in shape))
            test(name, value)
            axes = value.ndim - len(shape)
            leads[name] = value.shape[:axes]
            sizes.update(zip(shape, value.shape[axes:], strict=True))
        values.append(value)
    return values, leading(**leads)


def _components(value: Any, shape: Shape) -> Any:
    """Return a number, or the entries of a vector, as floats or arrays of the leading axes."""
    if value is None:
        return None
    if value.ndim == len(shape):
        return value.tolist()
    return list(np.moveaxis(value, -1, 0)) if shape else value


def entries_first(value: Any, entries: int, batch: int) -> Any:
    """Move the axes of entries before those of the batch, which is given so many axes. None stays."""
    if value is None:
        return None
    padded = value.reshape((1,) * (batch + entries - value.ndim) + value.shape)
    return np.asarray(padded.transpose(*range(batch, padded.ndim), *range(batch)), order='C')


def entries_last(value: Array, entries: int) -> Array:
    """Move the axes of the entries behind those of the batch."""
    return np.asarray(value.transpose(*range(entries, value.ndim), *range(entries)), order='C')


def _packed(result: Any, core: Shape, batch: tuple[int, ...]) -> Any:
    """Return a finite float, or an array with the leading axes of the batch, or raise ValueError."""
    if type(result) is float and not batch:
        if math.isfinite(result):
            return result
        raise ValueError
    if not batch:
        packed = np.array(result, dtype=np.float64)
    elif isinstance(result, np.ndarray) and result.ndim == len(batch) + len(core):
        shape = (*result.shape[: len(core)], *batch)
        # It may depend on some of the arguments only.
        whole = result if result.shape == shape else np.broadcast_to(result, shape).copy()
        packed = entries_last(whole, len(core))
    elif core:
        rows = result if len(core) == 2 else [result]
        packed = np.empty((*batch, len(rows), len(rows[0])))
        for i, row in enumerate(rows):
            for j, entry in enumerate(row):
                packed[..., i, j] = entry
        packed = packed if len(core) == 2 else packed[..., 0, :]
    else:
        packed = np.array(np.broadcast_to(result, batch))
    finite('result', packed)
    return packed
