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

"""Equations as functions of arrays: the body is the equation, a decorator checks what comes in.

    @formula('() -> (3,2)')
    def unicycle_jacobian(theta):
        return [[cos(theta), 0],
                [sin(theta), 0],
                [0,          1]]

    unicycle_jacobian(0.5)          # an array of shape (3, 2)
    unicycle_jacobian([0.5, 0.6])   # of shape (2, 3, 2)

The signature has the shapes of arguments and results: `()` is a number, `(3)` a vector, `(3,2)` a
matrix. In `(m,n),(n) -> (m)` a single letter is a size that is the same wherever it appears. A longer
name, as in `(joints) -> (3)`, is for methods only and means `self.joints`. Arguments may have further
axes in front, those of a batch: they broadcast, and results have them in front, too. An argument whose
default is None may be missing.

The body is written for one robot: a number is a float, a vector a list of floats, and it returns
numbers, lists of numbers, or matrices as lists of rows. For a batch the same body is evaluated once,
with arrays in place of the floats, which broadcast to the shape of the batch. So it uses the functions
of `numerics.elementary`: `where(x > 0, a, b)` instead of `if x > 0`, and `[2 * a for a in p]` instead of
`2 * p`, which repeats a list. A mistake of these kinds may not show before a batch of two.

If any argument is a matrix, all arguments are arrays with their entries first, also for one robot:

    @formula('(m,n),(n) -> (m)')
    def task_velocity(J, q_dot):    # shapes (m, n, ...) and (n, ...)
        return np.einsum('mn...,n...->m...', J, q_dot)

A bad argument raises a ValueError with its name, a missing one a TypeError, and a result that is
infinite or undefined a ValueError with the names of all arguments. `f.formula` is the body itself, for
callers whose numbers are checked: no checks, lists instead of arrays. `f.floats` is a copy of the body
for floats and lists of them, with the functions of `math`, for what runs for every message: it raises an
ArithmeticError or a ValueError where a branch of `where` is undefined, also if it is not taken.
"""

from __future__ import annotations

import functools
import inspect
import operator
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, ParamSpec, Protocol, TypeAlias, TypeVar, cast, overload

import numpy as np
from numpy.typing import NDArray

from diffdrive_jacobian.numerics.checks import Check, finite, leading, shaped
from diffdrive_jacobian.numerics.elementary import for_floats

__all__ = ['formula']

Array: TypeAlias = NDArray[np.float64]
Number: TypeAlias = Any
"""A float, or an array that broadcasts to the shape of a batch."""
Scalar: TypeAlias = float | Array
"""A number as a result: a float, or an array of the shape of a batch."""
Vector: TypeAlias = Any
"""A vector as an argument: its numbers in a sequence, or an array with its entries first."""
Entries: TypeAlias = list[Number]
"""A vector as a result."""
Rows: TypeAlias = list[list[Number]]
"""A matrix as a result."""
Size: TypeAlias = int | str
"""A number, or the name of one."""


def formula(signature: str, **checks: Check) -> _Decorator:
    """Return the decorator of an equation.

    Args:
        signature: Shapes of the arguments and the results, such as `(3),() -> (),()`.
        checks: What is required of an argument, by its name, a check of arrays such as `positive`; of
            others, that they are finite.
    """

    def decorate(body: Callable[..., Any]) -> Any:
        equation = _Equation(body, signature, checks)

        @functools.wraps(body)
        def checked(*args: Any, **kwargs: Any) -> Any:
            return equation(args, kwargs)

        def floats(*args: Any, **kwargs: Any) -> Any:
            # At the first call, because the body may call what is defined after it. Then the copy takes
            # the place of this function, for speed.
            if checked.floats is floats:  # type: ignore[attr-defined]
                checked.floats = for_floats(body)  # type: ignore[attr-defined]
            return checked.floats(*args, **kwargs)  # type: ignore[attr-defined]

        checked.formula, checked.floats = body, floats  # type: ignore[attr-defined]
        return checked

    return cast('_Decorator', decorate)


class _Equation:
    """A body, and what its signature says: `shapes` of the arguments, and `outputs` of the results.

    Of `(m,n),(n) -> (m)` they are `{'J': ('m', 'n'), 'q_dot': ('n',)}` and `[('m',)]`. A call learns its
    `sizes`, such as `{'m': 2, 'n': 3}`, and its `batch`: the axes to which those in front broadcast.
    """

    def __init__(self, body: Callable[..., Any], signature: str, checks: Mapping[str, Check]) -> None:
        self.body, self.checks, self.signature = body, checks, inspect.signature(body)
        if signature.count('->') != 1:
            raise TypeError(f'signature must be as (3),() -> (2), got {signature!r}')
        inputs, self.outputs = map(_shapes, signature.split('->'))
        parameters = self.signature.parameters
        names = [name for name in parameters if name != 'self']
        if not names:
            raise TypeError(f'{body.__name__} must have arguments, got none')
        if len(names) != len(inputs):
            raise TypeError(f'{signature} must have the arguments {", ".join(names)}, got {len(inputs)}')
        self.shapes = dict(zip(names, inputs, strict=True))
        if unknown := checks.keys() - self.shapes.keys():
            raise TypeError(f'checks must be of {", ".join(names)}, got {", ".join(sorted(unknown))}')
        self.of_matrices = any(len(shape) > 1 for shape in inputs)
        self.optional = {name for name in names if parameters[name].default is None}
        # The sizes that are attributes of self, as `joints`.
        self.attributes = {
            size
            for shape in [*inputs, *self.outputs]
            for size in shape
            if isinstance(size, str) and len(size) > 1
        }
        if self.attributes and 'self' not in parameters:
            name = min(self.attributes)
            raise TypeError(f'a size by a name, {name!r}, is for methods, got {body.__name__}')
        *others, last = names
        self.names = f'{", ".join(others)} and {last}' if others else last

    def __call__(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Bind the arguments to their names, check them, evaluate the body and pack what it returns."""
        try:
            bound = self.signature.bind(*args, **kwargs)
        except TypeError as error:
            raise TypeError(f'{self.body.__name__}: {error}; it takes {self.names}') from None
        owner = bound.arguments.get('self')
        sizes: dict[Size, int] = {name: getattr(owner, name) for name in self.attributes}
        batch = self._check(bound.arguments, sizes)
        results = self._evaluate(bound, batch)
        return self._pack(results, sizes, batch)

    def _check(self, arguments: dict[str, Any], sizes: dict[Size, int]) -> tuple[int, ...]:
        """Replace arguments by arrays, learn their sizes, and return the axes of the batch."""
        leads: dict[str, tuple[int, ...]] = {}
        for name, shape in self.shapes.items():
            if name in self.optional and arguments.get(name) is None:
                arguments.pop(name, None)
            elif name in arguments:
                # A number stands for itself. A letter stands for the first size that it is given.
                array = shaped(name, arguments[name], *(sizes.get(size, size) for size in shape))
                self.checks.get(name, finite)(name, array)  # an array is returned as it is
                own = array.ndim - len(shape)
                leads[name] = array.shape[:own]
                for size, length in zip(shape, array.shape[own:], strict=True):
                    if sizes.setdefault(size, length) != length:
                        raise ValueError(f'{name} must have as many rows as columns, got {array.shape}')
                arguments[name] = array
        return leading(**leads)

    def _evaluate(self, bound: inspect.BoundArguments, batch: tuple[int, ...]) -> Any:
        """Call the body: with floats and lists for one robot, with arrays for a batch.

        If that raises a ValueError or an ArithmeticError it is called again, with arrays, also of the
        entries of vectors: where floats raise, as at `math.sin(inf)` and `1.0 / 0.0`, also in a branch
        of `where` that is not taken, they give infinity or NaN. What the body itself refuses is raised
        again.
        """
        arguments = bound.arguments
        given = [name for name in self.shapes if name in arguments]
        for name in given:
            array, axes = arguments[name], len(self.shapes[name])
            if self.of_matrices:
                arguments[name] = entries_first(array, axes, len(batch))
            elif not batch:  # one robot: a float, or a list of floats
                arguments[name] = array.tolist()
            elif axes:  # the vectors of a batch: a list of their entries, which are arrays
                arguments[name] = list(np.moveaxis(array, -1, 0))
            # The numbers of a batch are an array already.
        with np.errstate(all='ignore'):
            with suppress(ArithmeticError, ValueError):
                return self.body(*bound.args, **bound.kwargs)
            for name in given:
                arguments[name] = np.asarray(arguments[name])
            try:
                return self.body(*bound.args, **bound.kwargs)
            except ArithmeticError:
                raise self._overflow() from None

    def _pack(self, results: Any, sizes: Mapping[Size, int], batch: tuple[int, ...]) -> Any:
        """Return results as arrays of the shapes that the signature says, a number as a float."""
        several = results if len(self.outputs) > 1 else [results]
        try:
            packed = [
                _packed(result, shape, sizes, batch)
                for result, shape in zip(several, self.outputs, strict=True)
            ]
        except (TypeError, ValueError) as error:
            raise TypeError(
                f'{self.body.__name__} must return what its signature says: {error}'
            ) from error
        if not all(np.isfinite(one).all() for one in packed):
            raise self._overflow()
        return tuple(packed) if len(self.outputs) > 1 else packed[0]

    def _overflow(self) -> ValueError:
        return ValueError(f'{self.names} must give a finite result, but it overflows or is undefined')


def _shapes(side: str) -> list[tuple[Size, ...]]:
    """Return the shapes in one side of a signature."""
    return [
        tuple(int(size) if size.isdigit() else size for size in re.findall(r'\w+', shape))
        for shape in re.findall(r'\(([^)]*)\)', side)
    ]


def entries_first(array: Array, own_axes: int, batch_axes: int) -> Array:
    """Turn (batch, m, n) into (m, n, batch); axes of the batch that are missing get the length 1."""
    padded = array.reshape((1,) * (batch_axes + own_axes - array.ndim) + array.shape)
    order = *range(batch_axes, padded.ndim), *range(batch_axes)
    return np.asarray(padded.transpose(order), order='C')


def entries_last(array: Array, own_axes: int) -> Array:
    """Turn (m, n, batch) into (batch, m, n)."""
    return np.asarray(array.transpose(*range(own_axes, array.ndim), *range(own_axes)), order='C')


def _packed(
    result: Any, shape: tuple[Size, ...], sizes: Mapping[Size, int], batch: tuple[int, ...]
) -> Any:
    """Return a number, or the entries of a vector or a matrix (a list of rows), as one array."""
    found: tuple[int, ...] = (len(result),) if shape else ()
    if len(shape) > 1:
        # Rows of different lengths give several sizes, which are refused below.
        found = *found, *sorted({len(row) for row in result})
    # A letter that no argument has is any size.
    wanted = tuple(sizes.get(size, size) for size in shape)
    if len(found) != len(wanted) or any(
        isinstance(want, int) and got != want for got, want in zip(found, wanted, strict=True)
    ):
        raise TypeError(f'the shape {wanted}, got {found}')
    packed = np.empty((*batch, *found))
    for index in np.ndindex(*found):
        # result[i] of a vector, result[i][j] of a matrix
        place = (Ellipsis, *index)
        packed[place] = functools.reduce(operator.getitem, index, result)
    return packed if packed.ndim else float(packed)


# --- For type checkers

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
