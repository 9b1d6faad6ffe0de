"""The directory in which a bag is written: what a killed process has left of it is removed."""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress

import pytest

from diffdrive_jacobian.bags.files import REPLACED, scratch_directory


@pytest.fixture
def remains(tmp_path):
    """Create what processes that were killed have left, by the end of its name."""
    made = {}
    for end in ('one', 'two', 'running', 'replacing', 'starting'):
        made[end] = tmp_path / f'.r[u]n.building-{end}'
        (made[end] / 'r[u]n').mkdir(parents=True)
        (made[end] / 'r[u]n' / 'r[u]n.mcap').write_bytes(b'data')
    (made['replacing'] / REPLACED).mkdir()
    (made['starting'] / 'r[u]n' / 'r[u]n.mcap').unlink()
    (made['starting'] / 'r[u]n').rmdir()
    return made


def test_remains_of_the_same_bag_are_removed(tmp_path, remains):
    other = tmp_path / '.other.building-x' / 'other'
    other.mkdir(parents=True)
    (tmp_path / 'precious').mkdir()
    (tmp_path / 'precious' / 'r[u]n').mkdir()
    (tmp_path / '.r[u]n.building-link').symlink_to('precious')
    running = os.open(remains['running'], os.O_RDONLY)
    fcntl.flock(running, fcntl.LOCK_EX)
    with scratch_directory(tmp_path / 'r[u]n') as scratch:
        (scratch / 'r[u]n').mkdir()
        with scratch_directory(tmp_path / 'r[u]n') as second:
            assert second != scratch
        assert scratch.exists()
    os.close(running)
    # Being written, with the bag that was replaced, about to be locked, a link, of another bag.
    kept = [remains[end] for end in ('running', 'replacing', 'starting')]
    assert sorted(tmp_path.iterdir()) == sorted(
        [*kept, tmp_path / '.r[u]n.building-link', tmp_path / 'precious', other.parent]
    )
    assert (tmp_path / 'precious' / 'r[u]n').exists()


def test_it_is_removed_also_after_an_error(tmp_path):
    with suppress(OSError), scratch_directory(tmp_path / 'run') as scratch:
        (scratch / 'run').mkdir()
        raise OSError('full')
    assert os.listdir(tmp_path) == []
