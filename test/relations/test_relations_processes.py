"""A node in another process under test."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from std_msgs.msg import Float64

from diffdrive_jacobian.relations import Late, Repeated, check_relation
from diffdrive_jacobian.testing import PropertyViolation

pytestmark = pytest.mark.process
PROGRAM = Path(__file__).parents[1] / 'lockstep' / 'external_nodes.py'


def answering(world, name):
    """Send three numbers to a node of a program."""
    world.start([sys.executable, str(PROGRAM), name])
    publisher = world.node.create_publisher(Float64, f'{name}/in', 10)
    for number in range(3):
        publisher.publish(Float64(data=float(number)))
        world.run_for(0.1)


def test_only_a_program_that_counts_is_found():
    check_relation(answering, Late('echo/in', 0.04), case='echo')
    words = r"Repeated\('ticker/in'\) is violated at 0.05 s: /ticker"
    with pytest.raises(PropertyViolation, match=words):
        check_relation(answering, Repeated('ticker/in'), case='ticker')
