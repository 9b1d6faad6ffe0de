"""The tool calibrate_run: its files, and a message for each mistake."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from calibration_data import JOINTS, NOMINAL, TRUE, Drive, Simulation, bag_messages, umbmark
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support.bags import count_more, write_bag
from support.ros_messages import twist

from diffdrive_jacobian.calibration import PARAMETERS, calibrate, fit
from diffdrive_jacobian.calibration.data import read_wheels_and_reference, wheel_names
from diffdrive_jacobian.parameters.nodes import WheelBridgeParameters
from diffdrive_jacobian.plots import calibration_figure
from diffdrive_jacobian.plots.calibration_figure import figure
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import calibrate_run as _calibrate_run
from diffdrive_jacobian.tools import drive_to
from diffdrive_jacobian.tools.calibrate_run import main

ROBOT = Simulation(drive=Drive.of(umbmark(side=0.6, runs=1)))


# At 25 Hz bags are written and read faster.
def at_25_hertz(recording):
    return replace(
        recording,
        wheel_time=recording.wheel_time[::2],
        wheel_angles=recording.wheel_angles[::2],
    )


RECORDING = at_25_hertz(ROBOT.recording(np.random.default_rng(1)))
DIMENSIONS = {'/wheel_bridge': {'wheel_radius': 0.033, 'wheel_separation': 0.16}}
STRAIGHT = replace(ROBOT, drive=Drive.of([(1.0, 0.0, 0.0), (20.0, 0.2, 0.0), (1.0, 0.0, 0.0)]))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """A drive of UMBmark with a reference as PoseStamped."""
    path = tmp_path_factory.mktemp('bags') / 'bag'
    return write_bag(path, bag_messages(RECORDING), parameters=DIMENSIONS)


@pytest.fixture(scope='module')
def plain(bag):
    """The multipliers that the tool finds for it."""
    path = bag.parent / 'plain.yaml'
    assert run(bag, '-o', path, '--no-plot') == 0
    return multipliers(path)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Where the tool works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return main([str(one) for one in arguments], Signals())


def short_recording(seconds=3.0):
    robot = replace(ROBOT, drive=Drive.of([(seconds, 0.2, 0.5)]))
    return robot.recording(np.random.default_rng(2))


def small(path, messages=None, *, parameters=DIMENSIONS, **how):
    """Write a bag of a few seconds."""
    sent = bag_messages(short_recording(), **how) if messages is None else messages
    return write_bag(path, sent, parameters=parameters)


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """A bag of a few seconds. It is not changed."""
    return small(tmp_path_factory.mktemp('small') / 'bag')


def refuses(capsys, code, *words):
    """Check that the tool printed one message, with these words, and no more."""
    out, err = capsys.readouterr()
    last = err.splitlines()[-1]
    assert last.startswith('calibrate_run: error: '), err
    assert all(word in last for word in words), last
    assert 'Traceback' not in err
    assert code in (1, 2)
    return out


def multipliers(path):
    values = yaml.safe_load(path.read_text())['/**']['ros__parameters']
    return [values[name] for name in PARAMETERS], values


# --- Result


@pytest.mark.slow
def test_it_writes_parameters_and_a_picture(bag, folder, capsys):
    assert run(bag, '-o', 'found.yaml') == 0
    found, values = multipliers(folder / 'found.yaml')
    np.testing.assert_allclose(found, TRUE, atol=0.01)
    assert (folder / 'found.png').read_bytes().startswith(b'\x89PNG')
    assert sorted(one.name for one in folder.iterdir()) == ['found.png', 'found.yaml']
    out, err = capsys.readouterr()
    assert err == ''
    assert out.endswith('found.yaml\nfound.png\n')
    assert all(f'{name}: {value:.5f} ± ' in out for name, value in zip(PARAMETERS, found, strict=True))
    # The bridge takes all of them, by these names.
    parameters = WheelBridgeParameters(**values)
    assert parameters.left_wheel_radius_multiplier == found[0]


def test_the_bridge_starts_with_the_file(plain, bag, lockstep):
    from diffdrive_jacobian.nodes.wheel_bridge import WheelBridge

    arguments = ['--ros-args', '--params-file', str(bag.parent / 'plain.yaml')]
    node = lockstep.add(WheelBridge(cli_args=arguments))
    assert [getattr(node.parameters, name) for name in PARAMETERS] == plain[0]


@pytest.mark.parametrize('kind', [PoseWithCovarianceStamped, Odometry])
def test_each_type_of_reference_gives_the_same(plain, folder, kind):
    other = write_bag(
        folder / 'other',
        bag_messages(RECORDING, kind=kind, topic='/ground_truth'),
        parameters=DIMENSIONS,
    )
    assert run(other, '--no-plot') == 0
    assert sorted(one.name for one in folder.iterdir()) == ['other', 'other_calibration.yaml']
    assert multipliers(folder / 'other_calibration.yaml') == plain


def test_speeds_and_another_clock_serve_too(folder, capsys):
    sent = bag_messages(RECORDING, position=False, clock=5e5)
    write_bag(folder / 'bag', sent, parameters=DIMENSIONS)
    assert run('bag', '-o', 'found.yaml', '--no-plot') == 0
    np.testing.assert_allclose(multipliers(folder / 'found.yaml')[0], TRUE, atol=0.02)
    said = capsys.readouterr().err
    assert 'integrated from the speeds' in said
    assert 'different clocks, so the times of recording are used' in said


def test_messages_that_the_bag_counts_and_lacks_are_reported(written, tmp_path):
    path = shutil.copytree(written, tmp_path / 'bag')
    assert read_wheels_and_reference(path).notes == ()
    count_more(path, '/joint_states', 7)
    notes = read_wheels_and_reference(path).notes
    assert notes == ('7 messages on /joint_states are missing in the bag',)


def test_known_quantities_are_options(bag, capsys):
    known = ['--lever-arm', 0, 0, '--yaw-offset', 0, '--time-offset', 0, '--wheel-noise', 1e-5]
    known += ['--position-noise', 0.005, '--heading-noise', 0.01]
    assert run(bag, '-o', 'found.yaml', '--no-plot', *known) == 0
    out = capsys.readouterr().out
    assert 'x 0.0000 (given) m, y 0.0000 (given) m, yaw 0.0000 (given) rad' in out
    assert 'wheel travel variance 1e-05 m, reference 0.005 m and 0.01 rad' in out
    assert 'time offset' not in out


def test_the_picture_shows_both_paths_and_the_errors():
    drawn = figure(calibrate([RECORDING], NOMINAL))
    plane, position, heading, residual = drawn.axes
    labels = [text.get_text() for text in plane.get_legend().get_texts()]
    assert labels == ['odometry before', 'odometry after', 'reference', 'start']
    for panel in (position, heading):
        before, after = (np.nanmax(np.abs(one.get_ydata())) for one in panel.lines[:2])
        assert after < before / 2.0
    assert 'mm' in residual.get_ylabel()


# --- Mistakes


def test_a_straight_drive_is_refused_in_words(folder, capsys):
    recording = STRAIGHT.recording(np.random.default_rng(3))
    write_bag(folder / 'straight', bag_messages(recording), parameters=DIMENSIONS)
    code = run('straight')
    out = refuses(capsys, code, 'does not determine the wheel separation: turn in place', 'Nothing')
    assert code == 1
    assert 'left_wheel_radius_multiplier' in out
    assert [one.name for one in folder.iterdir()] == ['straight']


def test_bags_that_disagree_are_refused(bag, folder, capsys):
    other = replace(ROBOT, multipliers=(1.0, 1.0, 1.0)).recording(np.random.default_rng(4))
    write_bag(folder / 'other', bag_messages(at_25_hertz(other)), parameters=DIMENSIONS)
    assert run(bag, 'other', '-o', 'found.yaml') == 1
    refuses(capsys, 1, 'the recordings disagree')
    assert [one.name for one in folder.iterdir()] == ['other']


def test_missing_topics_are_listed(folder, capsys):
    sent = [one for one in bag_messages(RECORDING)[:500] if one[1] != '/mocap/pose']
    small(folder / 'none', [*sent, (1.0, '/cmd_vel', twist(0.0, 0.0))])
    assert run('none') == 2
    refuses(capsys, 2, 'no topic ground_truth', '/cmd_vel (geometry_msgs/msg/Twist)', '/joint_states')
    small(folder / 'wheels', [one for one in bag_messages(RECORDING)[:500] if one[1] == '/mocap/pose'])
    assert run('wheels') == 2
    refuses(capsys, 2, 'no topic joint_states', '/mocap/pose (geometry_msgs/msg/PoseStamped)')


def test_wheels_that_are_given_are_not_looked_for():
    parameters = {'wheel_bridge': {'left_wheel_name': 'a', 'right_wheel_name': 'b'}}
    joints = ('a', 'b', 'left_wheel', 'right_wheel')
    assert wheel_names('run', '/joint_states', joints, ('b', 'left_wheel'), parameters) == (
        'b',
        'left_wheel',
    )
    assert wheel_names('run', '/joint_states', joints, None, parameters) == ('a', 'b')
    assert wheel_names('run', '/joint_states', joints[2:], None, parameters) == (
        'left_wheel',
        'right_wheel',
    )


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--reference', 'nothing'], ['no topic /nothing', '/mocap/pose']),
        (['--reference', 'joint_states'], ['must be of type nav_msgs/msg/Odometry']),
        (['--wheels-topic', '/mocap/pose'], ['must be of type sensor_msgs/msg/JointState']),
        (['--wheels', 'left', 'right'], ["no joint 'left'", JOINTS[0]]),
        (['--wheels', JOINTS[0], JOINTS[0]], ['both wheels', JOINTS[0]]),
        (['--wheel-radius', '50'], ['wheel radius must be in [0.001, 10] m, got 50.0']),
        (['-o', 'found.txt'], ['must end in .yaml']),
        (['-o', 'nowhere/found.yaml'], ['nowhere']),
    ],
)
def test_wrong_arguments(written, folder, capsys, arguments, words):
    shutil.copytree(written, folder / 'bag')
    assert run('bag', *arguments) == 2
    refuses(capsys, 2, *words)
    assert [one.name for one in folder.iterdir()] == ['bag']


@pytest.mark.parametrize(
    ('arguments', 'word'),
    [
        (['--wheel-radius', '-1'], 'must be positive'),
        (['--heading-noise', 'nan'], 'must be finite, got nan'),
        (['--yaw-offset', '90'], 'must be in radians'),
        (['-p', 'kp:=1'], 'takes no ROS arguments'),
        (['--lever-arm', '1'], 'expected 2 arguments'),
    ],
)
def test_arguments_that_are_refused_before_reading(capsys, arguments, word):
    with pytest.raises(SystemExit) as ended:
        run('bag', *arguments)
    assert ended.value.code == 2
    assert word in capsys.readouterr().err


def test_force_replaces_both_files(bag, folder, monkeypatch):
    monkeypatch.setattr(_calibrate_run, 'draw', lambda *_: b'picture')
    for name in ('found.yaml', 'found.png'):
        (folder / name).write_text('mine')
    assert run(bag, '-o', 'found.yaml', '--force') == 0
    assert 'multiplier' in (folder / 'found.yaml').read_text()
    assert (folder / 'found.png').read_bytes() == b'picture'


def test_nothing_stays_if_the_picture_cannot_be_written(bag, folder, capsys, monkeypatch):
    real = _calibrate_run.create
    monkeypatch.setattr(_calibrate_run, 'draw', lambda *_: b'picture')

    def create(path, data, *, replace):
        if path.suffix == '.png':
            raise OSError(28, 'No space left on device')
        real(path, data, replace=replace)

    monkeypatch.setattr(_calibrate_run, 'create', create)
    assert run(bag, '-o', 'found.yaml') == 1
    refuses(capsys, 1, 'No space left', 'nothing was written')
    assert list(folder.iterdir()) == []


def test_without_matplotlib_the_parameters_are_written(bag, folder, capsys, monkeypatch):
    def draw(*_):
        raise ModuleNotFoundError(name='matplotlib')

    monkeypatch.setattr(_calibrate_run, 'draw', draw)
    assert run(bag, '-o', 'found.yaml') == 0
    assert 'matplotlib is not installed' in capsys.readouterr().err
    assert [one.name for one in folder.iterdir()] == ['found.yaml']


def test_dimensions_must_be_known_and_agree(folder, capsys):
    small(folder / 'unknown', parameters=None)
    assert run('unknown') == 2
    refuses(capsys, 2, '--wheel-radius and --wheel-separation')
    differ = {**DIMENSIONS, '/other': {'wheel_radius': 0.05, 'wheel_separation': 0.3}}
    small(folder / 'differ', parameters=differ)
    assert run('differ') == 2
    refuses(capsys, 2, '0.033 and 0.16 m, 0.05 and 0.3 m')


def test_several_references_must_be_chosen_from(folder, capsys):
    recording = short_recording()
    sent = [*bag_messages(recording), *bag_messages(recording, topic='/slam')]
    small(folder / 'two', sorted(sent, key=lambda one: one[0]))
    assert run('two') == 2
    refuses(capsys, 2, 'several such topics, /mocap/pose, /slam: choose one with --reference')


def test_odometry_is_no_reference_unless_it_is_chosen(folder, capsys):
    small(folder / 'odom', kind=Odometry, topic='/odom')
    assert run('odom') == 2
    refuses(capsys, 2, 'no topic ground_truth', '/odom')


def change(sent, what):
    """Change the messages of a bag."""
    poses = [message for _, topic, message in sent if topic == '/mocap/pose']
    if what == 'frames':
        poses[3].header.frame_id = 'map'
    elif what == 'y up':
        for message in poses:
            place = message.pose.position
            place.y, place.z = 0.0, place.x
    elif what == 'NaN':
        for message in poses:
            message.pose.position.x = np.nan
    elif what == 'clock reset':
        for message in poses[10:]:
            message.header.stamp.sec -= 50
    elif what == 'counter reset':
        for message in [message for _, topic, message in sent if topic == '/joint_states'][100:]:
            message.position = [one - 50.0 for one in message.position]
    elif what == 'other joints':
        for message in [message for _, topic, message in sent if topic == '/joint_states']:
            message.name = ['arm']
            message.position, message.velocity = [0.0], []
    elif what == 'names':
        for message in [message for _, topic, message in sent if topic == '/joint_states']:
            message.name = ['a', 'b']
    return sent


@pytest.mark.parametrize(
    ('what', 'words'),
    [
        ('frames', ['in several frames', "'map'", "'mocap'"]),
        ('y up', ['not that of a floor with z up']),
        ('NaN', ['no usable message on /mocap/pose', 'invalid or implausible values']),
        ('clock reset', ['goes back in time by 49.', 'its clock was reset']),
        ('counter reset', ['jumps by 49.9 rad', 'its counter was reset']),
        ('names', ['--wheels LEFT RIGHT', "'a'", "'b'"]),
        ('other joints', ['--wheels LEFT RIGHT', "'arm'"]),
    ],
)
def test_faults_of_a_bag_are_named(folder, capsys, what, words):
    small(folder / 'bag', change(bag_messages(short_recording(6.0)), what))
    assert run('bag') == 2
    refuses(capsys, 2, *words)
    assert [one.name for one in folder.iterdir()] == ['bag']


def test_bad_messages_are_skipped_and_counted_and_angles_are_unwrapped(folder, capsys):
    sent = bag_messages(RECORDING)
    for _, _, message in sent:
        if hasattr(message, 'position'):
            message.position = [float(np.angle(np.exp(1j * one))) for one in message.position]
    poses = [message for _, topic, message in sent if topic == '/mocap/pose']
    for message in poses[20:23]:
        message.pose.position.x = np.nan
    write_bag(folder / 'bag', sent, parameters=DIMENSIONS)
    assert run('bag', '-o', 'found.yaml', '--no-plot') == 0
    np.testing.assert_allclose(multipliers(folder / 'found.yaml')[0], TRUE, atol=0.01)
    expected = '3 messages on /mocap/pose hold invalid or implausible values and were skipped'
    assert expected in capsys.readouterr().err


def test_odd_but_valid_bags_give_the_same(plain, folder):
    """UTM coordinates, joints of others between, messages twice and in another order."""
    sent = []
    for index, (time, topic, message) in enumerate(bag_messages(RECORDING)):
        if topic == '/mocap/pose':
            message.pose.position.x += 5e5
            message.pose.position.y += 5.4e6
        else:
            message.name = ['arm', *message.name]
            message.position = [0.1, *message.position]
            message.velocity = []
            if index % 10 == 0:
                other = JointState(header=message.header, name=['gripper'], position=[0.0])
                sent += [(time, topic, message), (time, topic, other)]
        # Received late, and so in another order than that of the stamps.
        sent.append((time + 0.1 * (index % 7 == 0), topic, message))
    write_bag(folder / 'odd', sorted(sent, key=lambda one: one[0]), parameters=DIMENSIONS)
    assert run('odd', '-o', 'odd.yaml', '--no-plot') == 0
    np.testing.assert_allclose(multipliers(folder / 'odd.yaml')[0], plain[0], atol=2e-6)


def test_too_short_a_drive(folder, capsys):
    robot = replace(ROBOT, drive=Drive.of([(1.0, 0.2, 0.5)]))
    small(folder / 'short', bag_messages(robot.recording(np.random.default_rng(2))))
    assert run('short') == 1
    refuses(capsys, 1, 'too short')
    assert run('short', 'short') == 2
    refuses(capsys, 2, 'each bag can be given once')


@pytest.mark.usefixtures('no_display')
def test_the_figure_needs_no_display():
    assert calibration_figure.draw(calibrate([RECORDING], NOMINAL), 'svg').startswith(b'<?xml')


@pytest.mark.slow
def test_the_recipe_of_the_page_determines_all_parameters(folder, monkeypatch):
    """The goals that doc/calibration.md gives, driven by drive_to."""
    page = (Path(__file__).parents[2] / 'doc' / 'calibration.md').read_text()
    goals = re.search(r'^drive_to ([-\d ]+?) --lockstep', page, re.MULTILINE).group(1).split()
    quick = ['--ros-args', '-p', 'kp:=12.0', '-p', 'kv:=3.0']
    assert drive_to.main([*goals, '--lockstep', '--no-plot', '-o', 'umbmark', *quick], Signals()) == 0
    read = read_wheels_and_reference('umbmark', reference='odom')
    assert read.dimensions == (0.033, 0.16)
    steps = []
    real = fit.linearized
    monkeypatch.setattr(fit, 'linearized', lambda *a, **how: steps.append(a) or real(*a, **how))
    perfect = calibrate([read.recording], NOMINAL)
    np.testing.assert_allclose(perfect.multipliers, 1.0, atol=1e-6)
    assert (np.sqrt(np.diag(perfect.covariance)) < 2e-4).all()
    assert any('odometry that was computed from these wheels' in note for note in perfect.notes)
    # The stamps of both are the same, so that the time offset is at kinks of the interpolated wheels.
    assert len(steps) <= 20
    # The same commands, driven by a robot with other wheels.
    time = read.recording.wheel_time
    robot = Simulation(drive=Drive(time=time, angles=read.recording.wheel_angles), rate=5)
    result = calibrate([robot.recording(np.random.default_rng(1))], NOMINAL)
    assert result.undetermined == []
    assert (np.sqrt(np.diag(result.covariance)) < 0.006).all()
    np.testing.assert_allclose(result.multipliers, TRUE, atol=0.018)
