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

"""What README.md and doc/ say is true: commands, code, outputs, parameters, topics, options, links."""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
from functools import cache
from importlib.metadata import entry_points as installed_entry_points
from importlib.util import find_spec

import numpy as np
import pytest
import yaml
from documentation import pages
from documentation.pages import PAGES, PARAMETERS, ROOT, blocks, check_output, is_run, run_page
from rclpy.parameter import Parameter

from diffdrive_jacobian import kinematics, plots
from diffdrive_jacobian.nodes.go_to_goal import GoToGoal
from diffdrive_jacobian.nodes.virtual_robot import VirtualRobot
from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

TEXTS = {name: path.read_text() for name, path in PAGES.items()}
BLOCKS = [block for text in TEXTS.values() for block in blocks(text)]
SKIPPED = [block for block in BLOCKS if 'skip' in block.notes]
MOST_SKIPPED = 10
"""Blocks in all pages that no test runs: they need pip, a ROS installation, a network, or run tests."""
NODES = {'virtual_robot': VirtualRobot, 'go_to_goal': GoToGoal, 'wheel_bridge': WheelBridge}
TOOLS = {
    one.name
    for one in installed_entry_points(group='console_scripts')
    if one.value.startswith('diffdrive_jacobian.tools.')
} - {*NODES, 'diffdrive_doctor'}
ITEMS = 138
"""What the five documents say, by the list of their items."""


def section(page, heading):
    """Return a section of a page, without its heading."""
    pattern = rf'^##+ `?{re.escape(heading)}`?\n(.*?)(?=^##? |^### |\Z)'
    return re.search(pattern, TEXTS[page], re.MULTILINE | re.DOTALL).group(1)


def table(text, begin):
    """Return the rows of the table whose head begins with some words."""
    return text.split(begin, 1)[1].split('\n\n', 1)[0].splitlines()[2:]


@cache
def library():
    """Return every public name of the packages without ROS, methods included."""
    names = set()
    for module in (
        *(importlib.import_module(f'diffdrive_jacobian.{layer}') for layer in ('control', 'simulation')),
        *(getattr(kinematics, name) for name in kinematics.__all__),
    ):
        for name, value in inspect.getmembers(module):
            names.add(name)
            if inspect.isclass(value):
                names.update(vars(value))
    return names


# --- Code


@pytest.mark.pages
@pytest.mark.process
@pytest.mark.parametrize('name', [name for name in PAGES if any(map(is_run, blocks(TEXTS[name])))])
def test_code_runs_and_prints_what_the_page_quotes(tmp_path, name):
    for quoted, printed in run_page(TEXTS[name], tmp_path):
        check_output(quoted, printed)


@pytest.mark.parametrize('part', ['', 'part, '])
def test_numbers_are_compared_in_exact_quotations_only(part):
    (loose, exact) = blocks(
        f'<!-- output: {part} -->\n```text\nat 1.25 s  x\n```\n'
        f'<!-- output: {part}exact -->\n```text\nat 1.25 s  x\n```\n'
    )
    check_output(loose, 'at 7.0 s x')
    # Processors round differently.
    check_output(exact, 'at 1.26 s x')
    for quoted, other in ((exact, 'at 1.27 s x'), (loose, 'at 1.25 ms x')):
        with pytest.raises(AssertionError):
            check_output(quoted, other)


def test_few_blocks_are_not_run_each_for_a_reason():
    assert all(block.notes['skip'] for block in SKIPPED)
    assert len(SKIPPED) <= MOST_SKIPPED


def test_every_note_belongs_to_a_block():
    for name, text in TEXTS.items():
        notes = re.findall(r'^<!-- (?:test|output)', text, re.MULTILINE)
        assert len(notes) == sum(len(block.notes) for block in blocks(text)), name


def test_the_first_example_gives_the_numbers_in_its_comments():
    code = next(block.code for block in blocks(TEXTS['README.md']) if 'q_dot =' in block.code)
    names = {}
    exec(code, names)
    comments = ' '.join(line.partition('#')[2] for line in code.splitlines())
    values = [names['v'], names['omega'], names['omega_R'], names['omega_L'], *names['q_dot']]
    assert re.findall(r'-?\d+\.\d{3}', comments)[:7] == [f'{value:.3f}' for value in values]


def test_workflow_is_valid_yaml():
    (code,) = [block.code for block in BLOCKS if (block.file or '').startswith('.github/')]
    assert yaml.safe_load(code)['jobs']


def examples():
    """Return the table from the documents to the code: what each example says and must give."""
    for row in table(TEXTS['doc/library.md'], '| document | function |'):
        what, functions, _, example = (cell.strip() for cell in row.strip('|').split('|'))
        yield pytest.param(functions, *re.findall(r'`([^`]+)`', example), id=what)


@pytest.mark.parametrize(('functions', 'first', 'second'), list(examples()))
def test_examples_of_the_documents_methods(functions, first, second):
    names = {}
    exec(next(b.code for b in blocks(TEXTS['doc/library.md']) if 'inverse_velocity' in b.code), names)
    exec(first, names)
    expression, expected = second.split('  # ')
    np.testing.assert_allclose(eval(expression, names), eval(expected), rtol=0.0, atol=6e-4)
    for function in re.findall(r'`([\w.]+)`', functions):
        assert function.split('.')[-1] in library(), function


# --- What is generated


@pytest.mark.parametrize('name', [name for name, text in TEXTS.items() if '<!-- body' in text])
def test_bodies_of_functions_are_as_in_the_source(name):
    text = TEXTS[name]
    assert text.count('<!-- body') == len(pages.BODY.findall(text)), 'a comment without its py block'
    assert text == pages.with_bodies(text), 'python test/documentation/pages.py bodies writes them'


def test_parameter_tables_are_as_generated():
    text = TEXTS['doc/nodes.md']
    assert all(f'<!-- parameters of {name} -->' in text for name in PARAMETERS)
    assert text == pages.with_parameter_tables(text), 'pages.py parameters writes them'


@pytest.mark.slow
def test_the_page_of_public_names_is_as_generated():
    """To write it, every public name is imported."""
    written = TEXTS['doc/public.md'] == pages.public_page()
    assert written, 'python test/documentation/pages.py public writes it'


# --- The documents, nodes and tools


def test_each_item_of_the_documents_is_in_one_table_with_functions_and_tests_that_exist():
    text = '\n'.join(TEXTS[f'doc/document_{name}.md'] for name in 'abcde')
    rows = re.findall(r'^\| (\d+) [^|]*\|([^|]*)\|(.*)', text, re.MULTILINE)
    assert [int(number) for number, _, _ in rows] == list(range(1, ITEMS + 1))
    known = {*library(), *plots.__all__, *TOOLS, *NODES}
    tests = {path.name for path in (ROOT / 'test').rglob('test_*.py')}
    for number, functions, rest in rows:
        named = {function.split('.')[-1] for function in re.findall(r'`([\w.]+)', functions)}
        assert named <= known, number
        assert {*re.findall(r'`(test_\w+\.py)', rest)} <= tests, number


@pytest.mark.parametrize('name', NODES)
def test_topics_and_services(lockstep, name):
    # The topics of a robot that slips are those of a perfect one, and ground_truth.
    slip = [Parameter('simulate_slip', value=True)] * (name == 'virtual_robot')
    node = lockstep.add(NODES[name](parameter_overrides=slip))
    rows = table(section('doc/nodes.md', name), '| topic')
    documented = {re.search(r'`/?(\w+)`', row).group(1) for row in rows}
    if find_spec('tf2_ros') is None:
        documented -= {'tf'}
    names = (
        node.get_publisher_names_and_types_by_node(name, '/')
        + node.get_subscriber_names_and_types_by_node(name, '/')
        + node.get_service_names_and_types_by_node(name, '/')
    )
    common = {'/rosout', '/parameter_events', '/clock'}
    own = {topic.strip('/') for topic, _ in names if topic.count('/') == 1 and topic not in common}
    if name == 'virtual_robot':
        # It is commanded by one of two topics.
        own.add('joint_command')
    assert documented == own


def options_of(tool):
    """Return the options of a tool, without those of every tool and those that it only refuses."""
    parser = importlib.import_module(f'diffdrive_jacobian.tools.{tool}')._parser()
    shown = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    options = {option for action in shown for option in action.option_strings}
    return options - {'-h', '--help', '--version'}


def test_options_of_the_tools():
    for tool in TOOLS:
        rows = re.findall(r'^\| (`-.*?) \| ', section('doc/tools.md', tool), re.MULTILINE)
        texts = re.findall(r'`(-[^`]+)`', ' '.join(rows))
        documented = {word for text in texts for word in re.findall(r'--?[a-z][a-z-]*', text)}
        assert documented == options_of(tool), tool


def test_options_in_blocks_that_are_not_run():
    for line in '\n'.join(block.code for block in SKIPPED).splitlines():
        command = line.split('#')[0].split('--ros-args')[0]
        words = command.replace('ros2 run diffdrive_jacobian', '').split()
        if words and words[0] in TOOLS:
            used = {word.split('=')[0] for word in words if re.match(r'--?[a-z]', word)}
            assert used <= options_of(words[0]), line


# --- Links


def without_code(text):
    return re.sub(r'```.*?```', '', text, flags=re.DOTALL)


def links(text):
    return re.findall(r'\]\(([^)\s]+)\)', without_code(text))


def anchors(text):
    """Return the anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r'^#+ (.*)$', without_code(text), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


LATEX = """
    begin end left right dot frac tfrac sqrt text mathrm mathcal mathbb mathrel quad qquad
    alpha beta gamma delta Delta theta lambda nu xi pi rho phi Phi psi omega
    cos sin cot exp log min det sum int partial cdot cdots vdots ddots times sim le lt in langle rangle
    rightarrow leftarrow Rightarrow overrightarrow mathbf hat max
"""
# Forges do not know each command: not operatorname, for example.


def test_equations_are_whole_and_of_known_commands():
    equation = re.compile(r'^ *```math\n(.*?)^ *```$', re.MULTILINE | re.DOTALL)
    equations = [found for text in TEXTS.values() for found in equation.findall(text)]
    assert len(equations) > 80
    for text in equations:
        assert set(re.findall(r'\\([A-Za-z]+)', text)) <= set(LATEX.split()), text
        for opens, closes in (('begin', 'end'), ('left', 'right')):
            first, last = (re.findall(rf'\\{word}\b({{\w+}})?', text) for word in (opens, closes))
            assert sorted(first) == sorted(last), text
        while (less := re.sub(r'{[^{}]*}', '', text)) != text:
            text = less
        assert not {'{', '}'} & set(text), text


def test_links_lead_somewhere():
    for name, text in TEXTS.items():
        for target in links(text):
            file, _, anchor = target.partition('#')
            path = (PAGES[name].parent / file).resolve() if file else PAGES[name]
            if not target.startswith(('http://', 'https://')):
                assert path.is_relative_to(ROOT), target
                assert path.exists(), target
                assert not anchor or anchor in anchors(path.read_text()), target


def test_every_page_is_reached_from_the_index():
    own = {name.removeprefix('doc/') for name in PAGES if name.startswith('doc/')}
    assert own - {'index.md'} <= {*links(TEXTS['doc/index.md'])}


def test_design_lists_every_package_and_files_that_exist():
    package = ROOT / 'diffdrive_jacobian'
    rows = table(section('doc/design.md', 'Packages'), '| package')
    listed = {re.match(r'\| `(\w+)` \|', row).group(1) for row in rows}
    packages = {path.parent.name for path in package.glob('*/__init__.py')}
    assert packages <= listed <= packages | {path.stem for path in package.glob('*.py')}
    for file in re.findall(r'`([\w/]+\.(?:py|rst))`', TEXTS['doc/design.md']):
        assert (package / file).exists() or (ROOT / file).exists(), file
