"""Equations as functions of arrays: the body is the equation, a decorator checks what comes in.

    @formula('() -> (3,2)')
    def unicycle_jacobian(theta):
        return [[cos(theta), 0],
                [sin(theta), 0],
                [0,          1]]

The signature is that of NumPy's generalized universal functions, without the leading axes: `()` is a
number, `(3)` a vector of three entries, `(3,2)` a matrix, and a letter a size that the arguments have in
common. In a method a word is an attribute: `(joints)` has the size `self.joints`. The leading axes of
all arguments broadcast, and the results have them. An argument whose default is None may be missing.

The body is written for one robot, in components: a number is a float, a vector a list of floats. For a
batch the same body is evaluated once, with arrays in place of the floats, so it uses the functions of
`numerics.elementary`. Results are numbers, lists of numbers, or matrices as lists of rows. Beside a
matrix all arguments are arrays with their entries first: vectors have the shape (n, ...), matrices
(m, n, ...), and `(a, b), (c, d) = J`. Results may be such arrays, too.

Bad arguments raise a ValueError that names the argument, and so does a result that overflows. The body
without these checks is `formula` of the decorated function: it is for callers whose numbers are checked.
The same body for floats alone is `floats`: it is for what runs for every message.
"""

from __future__ import annotations

import functools
import inspect
import operator
import re
from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, TypeAlias, TypeVar, cast, overload

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.numerics.checks import Check, finite, leading, shaped
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

    def __get__(self, instance: object, owner: type) -> Callable[..., R]:
        """Return the method of an object."""


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
        signature: Shapes of the arguments and the results, such as `(3),() -> (),()`.
        checks: What is required of an argument, by its name. All must be finite.
    """
    inputs, outputs = map(_shapes, signature.split('->'))
    of_matrices = any(len(shape) > 1 for shape in inputs)
    words = {size for shape in inputs for size in shape if isinstance(size, str) and len(size) > 1}

    def decorate(body: Callable[..., Any]) -> Any:
        called = inspect.signature(body)
        shapes = dict(zip((name for name in called.parameters if name != 'self'), inputs, strict=True))
        optional = {name for name in shapes if called.parameters[name].default is None}
        *others, last = shapes
        given = f'{", ".join(others)} and {last}' if others else last

        @functools.wraps(body)
        def checked(*args: Any, **kwargs: Any) -> Any:
            try:
                arguments = called.bind(*args, **kwargs).arguments
            except TypeError as error:
                raise TypeError(f'{body.__name__}: {error}; it takes {given}') from None
            owner: tuple[Any, ...] = (arguments.pop('self'),) if 'self' in arguments else ()
            sizes: dict[int | str, int] = {word: getattr(owner[0], word) for word in words}
            leads: dict[str, tuple[int, ...]] = {}
            for name, value in list(arguments.items()):
                if value is None and name in optional:
                    del arguments[name]
                    continue
                shape = shapes[name]
                array = shaped(name, value, *(sizes.get(size, size) for size in shape))
                checks.get(name, finite)(name, array)
                axes = array.ndim - len(shape)
                leads[name] = array.shape[:axes]
                sizes |= zip(shape, array.shape[axes:], strict=True)
                arguments[name] = array
            batch = leading(**leads)
            for name, array in arguments.items():
                if of_matrices:
                    arguments[name] = entries_first(array, len(shapes[name]), len(batch))
                elif not batch:
                    arguments[name] = array.tolist()
                elif shapes[name]:
                    arguments[name] = list(np.moveaxis(array, -1, 0))
            try:
                with np.errstate(all='ignore'):
                    results = body(*owner, **arguments)
                if len(outputs) == 1:
                    return _packed(results, len(outputs[0]), batch)
                return tuple(
                    _packed(result, len(shape), batch)
                    for result, shape in zip(results, outputs, strict=True)
                )
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


def _shapes(side: str) -> list[tuple[int | str, ...]]:
    """Return the shapes in one side of a signature."""
    return [
        tuple(int(size) if size.isdigit() else size for size in re.findall(r'\w+', shape))
        for shape in re.findall(r'\(([^)]*)\)', side)
    ]


def entries_first(value: Any, entries: int, batch: int) -> Array:
    """Move the axes of entries before those of the batch, which is given so many axes."""
    padded = value.reshape((1,) * (batch + entries - value.ndim) + value.shape)
    return np.asarray(padded.transpose(*range(batch, padded.ndim), *range(batch)), order='C')


def entries_last(value: Array, entries: int) -> Array:
    """Move the axes of the entries behind those of the batch."""
    return np.asarray(value.transpose(*range(entries, value.ndim), *range(entries)), order='C')


def _packed(result: Any, axes: int, batch: tuple[int, ...]) -> Any:
    """Return a number, a vector or a matrix with the leading axes of the batch, or raise ValueError."""
    sizes = [len(result[0]) if axis else len(result) for axis in range(axes)]
    packed = np.empty((*batch, *sizes))
    for index in np.ndindex(*sizes):
        place = (Ellipsis, *index)
        packed[place] = functools.reduce(operator.getitem, index, result)
    finite('result', packed)
    return packed if packed.ndim else float(packed)
