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

"""The decorator of equations: one body for one robot and for many, and errors that name the argument."""

import numpy as np
import pytest

from diffdrive_jacobian.numerics.checks import positive
from diffdrive_jacobian.numerics.elementary import cos, sin, where
from diffdrive_jacobian.numerics.formula import formula


@formula('(2),() -> (2)')
def rotated(point, angle):
    """Turn a point."""
    x, y = point
    return [cos(angle) * x - sin(angle) * y, sin(angle) * x + cos(angle) * y]


@formula('(),() -> (),()', r=positive)
def circle(r, angle):
    return r * cos(angle), r * sin(angle)


@formula('(n),(n) -> ()')
def inner(first, second):
    return sum(a * b for a, b in zip(first, second, strict=True))


@formula('(m,n),(),(n) -> (m),(n,m)')
def mapped(J, scale, q_dot):
    return scale * np.einsum('mn...,n...->m...', J, q_dot), scale * np.swapaxes(J, 0, 1)


@formula('(),() -> ()', scale=positive)
def scaled(x, *, scale=None):
    return x if scale is None else scale * x


@formula('(),() -> ()')
def ratio(a, b):
    return a / b


def test_numbers_give_floats_and_vectors_give_arrays():
    v, omega = circle(2.0, 0.5)
    assert type(v) is type(omega) is float
    assert rotated([1.0, 0.0], np.pi / 2) == pytest.approx([0.0, 1.0])
    assert rotated((1, 0), 0).dtype == np.float64
    assert (rotated.__name__, rotated.__doc__) == ('rotated', 'Turn a point.')


@pytest.mark.parametrize('lead', [(), (0,), (4, 3)])
def test_leading_axes_broadcast_and_the_result_has_its_own_memory(lead):
    points = np.random.default_rng(0).normal(size=(*lead, 2))
    found = rotated(points, np.zeros(lead[1:]))
    np.testing.assert_array_equal(found, points)
    assert not np.shares_memory(found, points)
    assert rotated(points, np.zeros((5, *[1] * len(lead)))).shape == (5, *lead, 2)


def test_beside_matrices_all_arguments_are_arrays_with_their_entries_first():
    J, scale = np.arange(12.0).reshape(2, 2, 3), np.array([[1.0], [2.0], [3.0]])
    x_dot, swapped = mapped(J, scale, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(x_dot, scale[..., np.newaxis] * J[..., 0])
    np.testing.assert_array_equal(swapped, scale[..., np.newaxis, np.newaxis] * J.swapaxes(-1, -2))
    assert swapped.flags.c_contiguous


@pytest.mark.parametrize(
    ('call', 'message'),
    [
        (lambda: rotated([1.0], 0.0), r'point must have shape \(\.\.\., 2\), got \(1,\)'),
        (lambda: inner([1.0] * 3, [1.0] * 2), r'second must have shape \(\.\.\., 3\), got \(2,\)'),
        (lambda: rotated(np.ones((2, 2)), [0.0] * 3), 'point and angle must have leading axes that b'),
        (lambda: circle([1.0, -1.0], 0.0), r'r must be positive and finite, got -1.0 at index 1'),
        (lambda: scaled(2.0, scale=-1.0), 'scale must be positive'),
        (lambda: ratio(1.0, 0.0), 'a and b must give a finite result'),
    ],
)
def test_a_bad_argument_is_named(call, message):
    with pytest.raises(ValueError, match=f'^{message}'):
        call()


def test_arguments_may_be_given_by_name_be_missing_or_positional_only():
    assert circle(angle=0.0, r=3.0) == (3.0, 0.0)
    assert scaled(2.0) == 2.0
    assert scaled(2.0, scale=3.0) == scaled(scale=3.0, x=2.0) == 6.0
    np.testing.assert_array_equal(scaled([1.0, 2.0], scale=[[1.0], [2.0]]), [[1.0, 2.0], [2.0, 4.0]])
    for call in (lambda: circle(1.0), lambda: circle(1.0, 2.0, 3.0), lambda: scaled(2.0, 3.0)):
        with pytest.raises(TypeError, match='it takes '):
            call()
    total = formula('(),() -> ()')(lambda x, y, /: x + y)
    assert total(1.0, 2.0) == 3.0


def test_the_equation_alone_is_not_checked():
    assert circle.formula(-1.0, 0.0) == (-1.0, 0.0)


def test_mistakes_in_a_body_are_not_called_an_overflow():
    @formula('(3) -> ()')
    def unpacks(x):
        a, b = x
        return a + b

    @formula('() -> ()')
    def refuses(x):
        if np.any(x > 1.0):
            raise ValueError('too far')
        return x

    with pytest.raises(ValueError, match='too many values to unpack'):
        unpacks([1.0, 2.0, 3.0])
    for far in (2.0, [0.0, 2.0]):
        with pytest.raises(ValueError, match='too far'):
            refuses(far)


@pytest.mark.parametrize(
    ('signature', 'body'),
    [
        ('(n) -> (n)', lambda x: [*x, 1.0]),
        ('(n) -> (2,n)', lambda x: [x, x[1:]]),
        ('() -> (2)', lambda x: [x]),
        ('(n) -> (),()', lambda x: x[0]),
    ],
)
def test_a_result_has_the_shape_of_the_signature(signature, body):
    with pytest.raises(TypeError, match='must return what its signature says: '):
        formula(signature)(body)([1.0, 2.0])


def test_the_equation_for_floats_is_made_once_also_in_a_function():
    gain = 2.0

    @formula('(),() -> ()')
    def scaled_sine(x, *, turns=0.0):
        return gain * sin(x + turns)

    first = scaled_sine.floats
    assert first(0.5) == first(0.5) == scaled_sine(0.5) == 2.0 * np.sin(0.5)
    assert scaled_sine.floats is not first


class Chain:
    """A method whose sizes are an attribute."""

    joints = 3

    @formula('(joints),() -> (joints)')
    def turned(self, q, angle):
        return [q_i + angle for q_i in q]

    @formula('() -> (joints)')
    def two_joints(self, angle):
        return [angle, angle]


def test_a_letter_is_one_size_within_an_argument_too():
    @formula('(m,m) -> (m)')
    def diagonal(A):
        return [A[i][i] for i in range(len(A))]

    assert diagonal([[1.0, 2.0], [3.0, 4.0]]).tolist() == [1.0, 4.0]
    for shape in (2, 3), (3, 2):
        with pytest.raises(ValueError, match=r'^A must have as many rows as columns, got \('):
            diagonal(np.zeros(shape))


def test_a_method_may_be_an_equation_with_sizes_by_a_name():
    chain = Chain()
    assert chain.turned([0.0, 1.0, 2.0], angle=1.0).tolist() == [1.0, 2.0, 3.0]
    assert chain.turned(np.zeros((4, 3)), [[1.0], [2.0]]).shape == (2, 4, 3)
    with pytest.raises(ValueError, match=r'^q must have shape \(\.\.\., 3\), got \(2,\)'):
        chain.turned([0.0, 1.0], 1.0)
    with pytest.raises(TypeError, match='it takes q and angle'):
        chain.turned([0.0, 1.0, 2.0])
    with pytest.raises(TypeError, match=r'what its signature says: the shape \(3,\), got \(2,\)'):
        chain.two_joints(1.0)


def test_a_branch_that_is_not_taken_does_no_harm():
    @formula('() -> ()')
    def inverse(x):
        return where(x > 0.0, 1.0 / x, 0.0)

    assert inverse(0.0) == 0.0
    assert inverse([0.0, 2.0]).tolist() == [0.0, 0.5]


@pytest.mark.parametrize(
    ('signature', 'body', 'words'),
    [
        ('(),()', lambda a, b: a + b, r"signature must be as \(3\),\(\) -> \(2\), got '\(\),\(\)'"),
        ('() -> ()', lambda a, b: a + b, 'must have the arguments a, b, got 1'),
        ('() -> ()', lambda: 1.0, 'must have arguments, got none'),
        ('(joints) -> ()', lambda q: q, "a size by a name, 'joints', is for methods"),
    ],
)
def test_a_signature_must_fit_its_body(signature, body, words):
    with pytest.raises(TypeError, match=words):
        formula(signature)(body)


def test_checks_are_of_arguments():
    with pytest.raises(TypeError, match='checks must be of r, L, got l'):
        formula('(),() -> ()', l=positive)(lambda r, L: r * L)
