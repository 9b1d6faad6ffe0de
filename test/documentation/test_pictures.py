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

"""The pictures of the documents and their command: they are drawn whole, and mistakes are reported."""

from __future__ import annotations

import itertools
import re
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.patches import Polygon
from matplotlib.text import Text
from support import commands

from diffdrive_jacobian import plots
from diffdrive_jacobian.kinematics.spatial_arm import IIWA
from diffdrive_jacobian.plots import arm_pictures, rendering, spatial_pictures

pytestmark = pytest.mark.slow
LARGEST = 100_000
"""Size of a picture (bytes)."""
ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty directory, the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


run = partial(commands.run, 'plot_jacobian')


# --- The pictures


@pytest.mark.parametrize('name', plots.PICTURES)
def test_a_picture_is_whole_and_does_not_depend_on_the_style_of_the_user(name):
    with matplotlib.rc_context({'text.usetex': True, 'font.size': 40.0, 'lines.linewidth': 20.0}):
        drawn = getattr(plots, name)()
    content = rendering.render(drawn, 'png')
    # The style of all is set by the same decorator.
    assert hasattr(getattr(plots, name), '__wrapped__')
    if name == 'geometry':
        assert rendering.render(plots.geometry(), 'png') == content
    assert len(content) < LARGEST
    # At its own resolution again.
    with rendering.styled():
        drawn.draw_without_rendering()
    texts = {one for one in drawn.findobj(Text) if one.get_visible() and one.get_text().strip()}
    boxes = {one: one.get_window_extent() for one in texts.difference(hidden(drawn))}
    assert boxes
    for text, box in boxes.items():
        assert drawn.bbox.x0 <= box.x0 < box.x1 <= drawn.bbox.x1, text
        assert drawn.bbox.y0 <= box.y0 < box.y1 <= drawn.bbox.y1, text
    for (one, box), (other, second) in itertools.combinations(boxes.items(), 2):
        # Boxes of letters that lean have room in their corners.
        assert not box.padded(-1.0).overlaps(second.padded(-1.0)), (one, other)


def hidden(drawn):
    """Return the texts of axes that are off, and of ticks outside, which are not drawn."""
    for axes in drawn.axes:
        for at, axis in enumerate((axes.xaxis, axes.yaxis)):
            low, high = sorted(axis.get_view_interval())
            for text in axis.findobj(Text):
                inside = text is axis.label or low <= text.get_position()[at] <= high
                if not (axes.axison and inside):
                    yield text


def test_the_ellipses_are_a_line_at_the_axle_and_a_circle_at_half_the_wheel_separation():
    (axes,) = plots.velocity_ellipses(r=0.05, L=0.4).axes
    shapes = [one for one in axes.patches if isinstance(one, Polygon) and len(one.get_xy()) > 100]
    boxes = [one.get_extents().transformed(axes.transData.inverted()) for one in shapes[1:]]
    np.testing.assert_allclose([box.x0 + box.width / 2 for box in boxes], [0, 0.1, 0.2, 0.4], atol=1e-9)
    ratios = [box.height / box.width for box in boxes]  # 2 d / L
    np.testing.assert_allclose(ratios, [0.0, 0.5, 1.0, 2.0], atol=1e-3)


def arrows(axes, begin):
    """Return the vectors of the arrows that begin at a point."""
    drawn = [one for one in axes.texts if one.arrow_patch is not None]
    return [np.subtract(one.xy, one.xyann) for one in drawn if np.allclose(one.xyann, begin)]


def test_the_axle_centre_is_half_way_between_the_wheel_centres_and_faces_forward():
    (axes,) = plots.figure_2(L=0.3).axes
    C_1, C_2, C = (one.get_xydata()[0] for one in axes.lines if one.get_marker() == 'o')
    np.testing.assert_allclose((C_1 + C_2) / 2.0, C)
    assert np.linalg.norm(C_1 - C_2) == pytest.approx(0.3)
    along = [vector @ (C_1 - C_2) / np.linalg.norm(vector) / 0.3 for vector in arrows(axes, C)]
    # The heading, v_C, e_f, e_l.
    np.testing.assert_allclose(along, [0.0, 0.0, 0.0, -1.0], atol=1e-12)


def test_the_columns_of_the_wheel_cancel_at_the_ground():
    (axes,) = plots.wheel(r=0.5).axes
    at_ground = arrows(axes, [1.0, 0.0])
    assert len(at_ground) == 2
    np.testing.assert_allclose(np.sum(at_ground, axis=0), 0.0, atol=1e-12)


def test_the_feet_of_the_legs_stand_on_the_ground():
    (axes,) = plots.legs().axes
    drawn = [one.get_xydata() for one in axes.lines if len(one.get_xydata()) == 3]
    np.testing.assert_allclose([leg[-1] for leg in drawn], arm_pictures.FEET)
    lengths = np.linalg.norm(np.diff(drawn, axis=1), axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(arm_pictures.LEG.lengths, (2, 2)))


def test_the_elbow_moves_and_damping_bounds_the_joints():
    q = spatial_pictures.self_motion()
    hands = IIWA.forward_kinematics(q)
    assert np.abs(hands - hands[0]).max() < 1e-4
    exact, damped = (spatial_pictures.outwards(damped=damped) for damped in (False, True))
    fastest = [np.linalg.norm(run[2], axis=-1).max() for run in (exact, damped)]
    assert fastest[1] < 0.5 * fastest[0]
    assert exact[3].max() < 1e-3 < damped[3].max() < 5e-3


def test_every_picture_is_public_in_the_documentation_and_in_the_help():
    figures = {f'{what}_figure' for what in ('calibration', 'run', 'sweep')}
    assert {*plots.PICTURES, 'PICTURES', 'Film', *figures} == {*plots.__all__}
    table = (ROOT / 'doc' / 'documents.md').read_text().split('| name | shows |', 1)[1].split('\n\n')[0]
    assert dict(re.findall(r'^\| `(\w+)` \| (.*) \|$', table, re.MULTILINE)) == plots.PICTURES
    helped = run('--help').out
    assert all(f'  {name}' in helped and what in helped for name, what in plots.PICTURES.items())


# --- The command


@pytest.mark.parametrize(
    ('arguments', 'file', 'begin'),
    [
        ((), 'geometry.png', b'\x89PNG'),
        (('-o', 'a.svg', '--force'), 'a.svg', b'<?xml'),
        (('--output', 'a.pdf'), 'a.pdf', b'%PDF'),
    ],
)
def test_the_command_writes_a_picture(folder, arguments, file, begin):
    if '--force' in arguments:
        (folder / file).write_bytes(b'replaced')
    assert run('geometry', *arguments) == (0, f'{file}\n', '')
    assert [one.name for one in folder.iterdir()] == [file]
    assert (folder / file).read_bytes().startswith(begin)


DH = 'a: [0, 0.4, 0.3]\nalpha: [1.5708, 0, 0]\nd: [0.2, 0, 0]\n'


@pytest.mark.parametrize(
    ('options', 'axes', 'rings'),
    [
        (('--lengths', '1', '0.7', '0.3', '--q', '0.5', '-1', '1'), 'x [m]', 2),
        (('--lengths', '1', '1', '--q', '0', '0'), 'x [m]', 2),
        (('--dh', 'slides.yaml', '--q', '0.5', '-1', '0.1'), 'z [m]', 6),
    ],
)
def test_any_arm_is_drawn_at_one_configuration(folder, monkeypatch, options, axes, rings):
    """An ellipse of velocities and one of forces, three of each in space."""
    (folder / 'slides.yaml').write_text(DH + 'theta: 0.1\nprismatic: [2]\n')
    drawn = []
    monkeypatch.setattr(rendering, 'render', lambda figure, ending: drawn.append(figure) or b'')
    assert run('arm_at', *options).code == 0
    (plane,) = drawn[0].axes
    assert axes in {plane.get_xlabel(), getattr(plane, 'get_zlabel', str)()}
    # Of 100 points, or two lines where a force may be infinite.
    assert len([line for line in plane.lines if len(line.get_xdata()) in (100, 5)]) == rings


@pytest.mark.parametrize(
    'text', ['3', DH + 'b: 1', DH.replace('0.3', 'x'), 'a: [', 'd: &d 0\na: *d\nalpha: 0']
)
def test_a_file_without_an_arm_is_refused(folder, text):
    (folder / 'arm.yaml').write_text(text)
    message = commands.refused('plot_jacobian', 'arm_at', '--dh', 'arm.yaml')
    assert 'arm.yaml must be a map with a, alpha and d, and perhaps theta' in message
    assert [one.name for one in folder.iterdir()] == ['arm.yaml']


@pytest.mark.parametrize(
    ('arguments', 'code', 'message'),
    [
        (('geomtry',), 2, "argument NAME: must be one of geometry, .*got 'geomtry'"),
        (('geometry', '-o', 'a.jpg'), 2, 'the picture must end in .png, .svg, .pdf'),
        (('geometry', '--q', '1'), 2, '--q has no effect with geometry, but with arm_at'),
        (('damping', '--dh', 'a.yaml'), 2, '--dh has no effect with damping, but with arm_at'),
        (('arm_at', '--q', '1'), 2, 'q must have shape'),
        (('arm_at', '--lengths', '1e300'), 2, 'the size of an arm to draw must be'),
        (('arm_at', '--lengths', '1', '--dh', 'a.yaml'), 2, '--lengths and --dh exclude each other'),
        (('arm_at', '--dh', 'a.yaml'), 2, '--dh a.yaml cannot be read: No such file'),
        (('arm_ellipses', '--lengths', '1', '1', '1'), 2, 'the arm must have 2 links'),
        (('geometry', '--ros-args'), 2, '.*plot_jacobian takes no ROS arguments'),
        (('geometry', '-o', 'none/a.png'), 1, 'none/a.png cannot be written: No such file'),
    ],
)
def test_mistakes_are_reported(folder, arguments, code, message):
    assert re.match(message, commands.refused('plot_jacobian', *arguments, code=code))
    assert not list(folder.iterdir())
