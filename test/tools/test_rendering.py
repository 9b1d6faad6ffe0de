"""Files of figures: those that `Figure.savefig` writes, drawn once instead of twice."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.image import imread

from diffdrive_jacobian.plots.rendering import DPI, render


def sample():
    """Return a figure with a layout, whose axes change their limits with their size."""
    drawing = Figure(figsize=(3.0, 2.0), layout='constrained')
    plane, over_time = drawing.subplots(1, 2)
    plane.plot([0.0, 1000.0], [0.0, 0.5])
    plane.set_aspect('equal', adjustable='datalim')
    plane.set(xlabel='x [m]', title='plane')
    over_time.plot([0.0, 1.0, 2.0], [3.0, 1.0, 2.0], label='speed')
    drawing.legend(loc='outside upper right')
    return drawing


@pytest.mark.parametrize('ending', ['png', 'svg'])
def test_a_file_is_that_of_savefig_and_drawn_once(monkeypatch, ending):
    monkeypatch.setenv('SOURCE_DATE_EPOCH', '0')
    expected, drawing, drawn = io.BytesIO(), sample(), []
    draw = Figure.draw
    with rc_context({'svg.hashsalt': 'salt'}):
        sample().savefig(expected, format=ending, dpi=DPI)
        monkeypatch.setattr(Figure, 'draw', lambda self, *given: drawn.append(1) or draw(self, *given))
        content = render(drawing, ending)
    assert len(drawn) == 1
    if ending == 'png':
        np.testing.assert_array_equal(
            imread(io.BytesIO(content)), imread(io.BytesIO(expected.getvalue()))
        )
    else:
        assert content == expected.getvalue()


@pytest.mark.parametrize('end', [0.8, 1.7])
def test_labels_are_inside_although_the_ticks_change_with_the_layout(end):
    """With equal scales the limits, and so the tick labels, follow from the size of the axes."""
    drawing = Figure(figsize=(3.4, 2.0), layout='constrained')
    plane, _ = drawing.subplots(1, 2)
    plane.plot([0.0, end], [0.0, end])
    plane.margins(0.2)
    plane.set_aspect('equal', adjustable='datalim')
    plane.set(ylabel='y [m]')
    render(drawing, 'png')
    assert plane.yaxis.label.get_window_extent().x0 > 2.0
