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

"""Paths by a text: shapes, files of poses, and bad files."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from diffdrive_jacobian.control.path_source import PathError, planned_path


def test_a_circle_and_a_line():
    circle = planned_path('circle:0.5')
    assert (circle.length, circle.closed) == (pytest.approx(math.pi), True)
    assert_allclose(np.hypot(circle.poses[:, 0], circle.poses[:, 1] - 0.5), 0.5)
    assert circle.at(0.1, 1.0).omega == pytest.approx(2.0)
    assert_allclose(circle.poses[[0, -1]], 0.0, atol=1e-6)
    assert planned_path('circle:1e3').length == pytest.approx(2e3 * math.pi)
    line = planned_path('line:2')
    assert (line.length, line.closed) == (pytest.approx(2.0), False)
    assert_allclose(line.poses[:, 1:], 0.0)
    assert line.poses[-1, 0] == 2.0


FILES = [
    ('a.csv', 'x,y,theta,t\n0,1,0.5,3\n2,3,0.25,4\n'),
    ('a.csv', '# mine\n\nt, y, x, theta\r\n3,1,0,0.5\r\n4,3,2,0.25\r\n'),
    ('a.csv', '0,1,0.5,3\n2,3,0.25,4'),
    ('a.csv', '\ufefftime_s,x_m,y_m,theta_rad,v_mps\n3,0,1,0.5,\n4,2,3,0.25,1\n'),
    ('a.yaml', '[[0, 1, 0.5, 3], [2, 3, 0.25, 4]]'),
    ('a.yml', 'poses:\n- {x: 0, y: 1, theta: 0.5, t: 3}\n- {t: 4, x: 2, y: 3, theta: 0.25}\n'),
]


def test_files(tmp_path):
    for name, content in FILES:
        (tmp_path / name).write_text(content)
        path = planned_path(str(tmp_path / name))
        assert path.poses.tolist() == [[0.0, 1.0, 0.5], [2.0, 3.0, 0.25]], content
        assert path.times.tolist() == [0.0, 1.0], content
    (tmp_path / 'b.csv').write_text('x,y\n0,0\n1,0\n')
    path = planned_path(str(tmp_path / 'b.csv'))
    assert path.poses.tolist() == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert path.times is None


BAD_FILES = [
    ('a.csv', b'', 'a pose in each line, got none'),
    ('a.csv', b'x,y\n', 'a pose in each line, got none'),
    ('a.csv', b'x,y\n1,2\n3\n', 'line 3 must have 2 columns, got 1'),
    ('a.csv', b'x,y\n1,2\n3,nan\n', "line 3: y must be a finite number, got 'nan'"),
    ('a.csv', b'x,theta\n1,2\n', 'must have x and y'),
    ('a.csv', b'x,x_m,y\n1,2,3\n', 'different names, got x, x_m, y'),
    ('a.csv', b'1,2,3,4,5\n', 'without names must be x, y.*got 5'),
    ('a.csv', b'x,y,t\n0,0,0\n1,0,2\n2,0,1\n', 'got 1 s after 2 s at index 2'),
    ('a.csv', b'\xff\xfe\x80', 'must be text in UTF-8'),
    ('a.csv', b'x,y\n"' + b'a' * 300_000, 'a.csv: '),
    ('a.csv', b'1,2\n' * 100_001, 'at most 100000 poses'),
    ('a.csv', b'1,2\n' * 5_000_001, 'at most 20.* MB, got 20'),
    ('a.yaml', b'\xff\xfe\x80', 'must be text in UTF-8'),
    ('a.yaml', b'[[0, 0], [1', 'must be YAML'),
    ('a.yaml', b'path: 3', "list of poses or have one as 'poses', got {'path': 3}"),
    ('a.yaml', b'[]', 'list of poses'),
    ('a.yaml', b'[[0, 0], 3]', 'pose 2 must be .x, y., .x, y, theta. or a map, got 3'),
    ('a.yaml', b'[[0, 0], [1, true]]', 'pose 2: y must be a finite number, got True'),
    ('a.yaml', b'[[0, 0], [1, 2, 3]]', 'pose 2 must have x, y as the first pose has'),
    ('a.yaml', b'[{x: 1}]', 'pose 1: columns must have x and y'),
    ('a.txt', b'1,2\n', 'path must be circle:RADIUS'),
]


def test_bad_files(tmp_path):
    for name, content, message in BAD_FILES:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(PathError, match=message):
            planned_path(str(tmp_path / name))


def test_texts_that_are_neither_a_shape_nor_a_file(tmp_path):
    for text in ('circle:0', 'circle:-1', 'eight:nan', 'line:inf', 'line:a', 'circle:1e308'):
        with pytest.raises(PathError, match=f"in .0.001, 100000. m, got '{text}'"):
            planned_path(text)
    for text in ('circle', 'line:'):
        with pytest.raises(PathError, match=f'{text.strip(":")} needs its size'):
            planned_path(text)
    for text in (str(tmp_path / 'missing.csv'), str(tmp_path) + '.csv', 'a\0b.csv', 'square:1'):
        with pytest.raises(PathError):
            planned_path(text)
