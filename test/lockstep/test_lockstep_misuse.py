"""Misuse of a lockstep world is named."""

from __future__ import annotations

import re
import threading

import pytest
import rclpy
from geometry_msgs.msg import Twist, Vector3
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile
from rclpy.task import Future
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import Empty, Trigger
from users_nodes import Blinker

from diffdrive_jacobian.testing import Lockstep, LockstepError


@pytest.mark.parametrize('seconds', [0.0, -1.0, float('nan'), float('inf'), 1e-10, 1e10])
def test_times_that_cannot_be_are_refused(lockstep, seconds):
    for advance in (lockstep.run_for, lockstep.step):
        with pytest.raises(
            ValueError, match=rf'must be in \[1e-09, 2147483647\] s, got {re.escape(str(seconds))}'
        ):
            advance(seconds)
    with pytest.raises(ValueError, match='timeout must be'):
        lockstep.run_until(bool, timeout=seconds)
    assert lockstep.elapsed == 0.0


@pytest.mark.parametrize(
    ('seconds', 'words'), [(0.0, 'not zero'), (-1.0, 'a time after 0'), (float('nan'), 'nan')]
)
def test_invalid_jumps_are_refused(lockstep, seconds, words):
    with pytest.raises(ValueError, match=words):
        lockstep.jump(seconds)


def test_invalid_use_is_refused(lockstep):
    with pytest.raises(LockstepError, match='another Lockstep is open in this process'):
        Lockstep()
    lockstep.close()
    for wrong in ({'start': 0.0}, {'start': -1.0}, {'patience': 0.0}):
        with pytest.raises(ValueError, match=r'must be in \[1e-09, 2147483647\] s'):
            Lockstep(**wrong)
    with pytest.raises(LockstepError, match='ROS arguments'):
        Lockstep(['--ros-args', '--no-such-option'])
    rclpy.init()
    try:
        with pytest.raises(LockstepError, match='rclpy is already initialized'):
            Lockstep()
    finally:
        rclpy.shutdown()
    failures = []

    def in_a_thread():
        try:
            Lockstep()
        except LockstepError as error:
            failures.append(str(error))

    thread = threading.Thread(target=in_a_thread)
    thread.start()
    thread.join()
    assert failures == ['Lockstep must be created and used in the main thread']
    with Lockstep() as world:
        world.add(Blinker())


def test_a_second_initialization_is_an_error_with_its_remedy(lockstep):
    """Also for those who expect that of rclpy."""
    for error in (LockstepError, RuntimeError):
        with pytest.raises(error, match=r'leave out rclpy.init\(\)'):
            rclpy.init()
    lockstep.add(Blinker())
    with Context() as other:
        assert other.ok()
    lockstep.close()
    rclpy.init()
    rclpy.shutdown()


LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_a_message_that_does_not_reach_a_latched_subscription_is_an_error(lockstep):
    """Alone, and beside one that it reaches."""
    planner, heard = lockstep.add(Node('planner')), []
    planner.create_subscription(Vector3, 'map', heard.append, LATCHED)
    words = (
        r'/map is subscribed to by /planner with .* reliable, transient local, .*'
        r'reliable, volatile, .* reach it: publish\(..., latched=True\)'
    )
    for _ in range(2):
        with pytest.raises(LockstepError, match=words):
            lockstep.publish('map', Vector3())
    beside = lockstep.listen(Vector3, 'map')
    with pytest.raises(LockstepError, match=words):
        lockstep.publish('map', Vector3())
    lockstep.publish('map', Vector3(x=1.0), latched=True)
    assert heard == beside == [Vector3(x=1.0)]


def test_a_quality_of_service_without_a_remedy_is_named(lockstep):
    planner = lockstep.add(Node('planner'))
    short, manual = Duration(seconds=0.1), LivelinessPolicy.MANUAL_BY_TOPIC
    for topic, words, policies in (
        ('often', 'deadline 0.1 s', {'deadline': short}),
        ('alive', 'liveliness manual by topic', {'liveliness': manual}),
        ('leased', 'lease 0.1 s', {'liveliness_lease_duration': short}),
    ):
        planner.create_subscription(Vector3, topic, print, QoSProfile(depth=1, **policies))
        for latched in (False, True):
            with pytest.raises(
                LockstepError,
                match=rf'/{topic} is subscribed to by /planner .*, {words}, and .* not reach it\n',
            ):
                lockstep.publish(topic, Vector3(), latched=latched)


def test_a_latched_message_waits_for_its_subscriptions(lockstep):
    for number in range(3):
        lockstep.publish('map', Vector3(x=float(number)), latched=True)
    planner, heard = Node('planner'), []
    planner.create_subscription(Vector3, 'map', heard.append, LATCHED)
    lockstep.add(planner)
    assert heard == [Vector3(x=2.0)]
    assert len(lockstep.listen(Vector3, 'map', latched=True)) == 3


class Threaded(Node):
    """Publishes in threads of its own, also while its callback waits for one."""

    def __init__(self, name='threaded'):
        super().__init__(name, start_parameter_services=False)
        self.publisher = self.create_publisher(Vector3, 'spectrum', 10)
        self.client = self.create_client(Empty, 'erase')
        self.create_subscription(Twist, 'twist', lambda _: self.in_thread(self.publish), 10)

    def publish(self):
        self.publisher.publish(Vector3())

    def call(self):
        self.client.call_async(Empty.Request())

    @staticmethod
    def in_thread(function):
        thread = threading.Thread(target=function, name='worker')
        thread.start()
        thread.join()


def test_what_a_node_sends_from_a_thread_of_its_own_is_an_error(lockstep):
    node = lockstep.add(Threaded())
    publishes = "node /threaded publishes /spectrum from a thread of its own ('worker')"
    for use in (
        lambda: lockstep.last('spectrum'),
        lambda: lockstep.run_for(0.1),
        lambda: lockstep.step(0.1),
        lambda: lockstep.finish(),
    ):
        node.in_thread(node.publish)
        with pytest.raises(LockstepError, match=re.escape(publishes)):
            use()
    node.in_thread(node.call)
    with pytest.raises(LockstepError, match='node /threaded calls or answers /erase from a thread of'):
        lockstep.run_for(0.1)
    with pytest.raises(LockstepError, match=re.escape(publishes)):
        lockstep.publish('twist', Twist())
    lockstep.run_for(0.1)
    node.publish()
    lockstep.settle()
    assert lockstep.last('spectrum') == Vector3()


def test_what_a_thread_sends_before_it_destroys_the_publisher_is_an_error(lockstep):
    node = lockstep.add(Threaded())

    def last_words():
        node.publish()
        node.destroy_publisher(node.publisher)

    node.in_thread(last_words)
    with pytest.raises(LockstepError, match='node /threaded publishes /spectrum from a thread'):
        lockstep.run_for(0.1)


def test_what_a_helper_that_was_not_added_sends_from_a_thread_is_an_error(lockstep):
    """As a node that publishes through a second node of its own."""
    node = lockstep.add(Node('composed'))
    helper = Threaded('helper')
    node.create_timer(0.1, lambda: helper.in_thread(helper.publish))
    # Nobody receives it.
    lockstep.run_for(0.1)
    lockstep.listen(Vector3, 'spectrum')
    words = (
        r"node /helper publishes /spectrum from a thread .*\('worker'\): .* add it with lockstep\.add"
    )
    with pytest.raises(LockstepError, match=words) as caught:
        lockstep.run_for(0.1)
    assert '  /spectrum: 2 from /helper, ' in str(caught.value)
    helper.in_thread(helper.call)
    with pytest.raises(LockstepError, match='node /helper calls or answers /erase from a thread'):
        lockstep.settle()


def test_a_node_may_be_created_in_a_thread(lockstep):
    """Only what it sends after it was added counts."""
    lockstep.listen(Vector3, 'spectrum')
    created = []

    def create():
        node = Threaded()
        node.declare_parameter('window', 5)
        node.publish()
        created.append(node)

    Threaded.in_thread(create)
    (node,) = created
    lockstep.add(node)
    lockstep.run_for(0.1)
    assert lockstep.last('spectrum') == Vector3()
    node.in_thread(node.publish)
    with pytest.raises(LockstepError, match='node /threaded publishes /spectrum from a thread'):
        lockstep.run_for(0.1)


def test_threads_of_others_do_not_matter(lockstep):
    with Context() as context:
        stranger = Node('stranger', context=context)
        publisher = stranger.create_publisher(Vector3, 'spectrum', 10)
        thread = threading.Thread(target=publisher.publish, args=(Vector3(),))
        thread.start()
        thread.join()
        lockstep.run_for(0.1)
        stranger.destroy_node()


def test_nodes_that_cannot_be_added_are_refused(lockstep):
    blinker = lockstep.add(Blinker())
    with pytest.raises(LockstepError, match='node /blinker was already added'):
        lockstep.add(blinker)
    with Context() as context:
        stranger = Node('stranger', context=context)
        with pytest.raises(LockstepError, match='node /stranger is in another context'):
            lockstep.add(stranger)
        stranger.destroy_node()
    wall = Node('wall', parameter_overrides=[Parameter('use_sim_time', value=False)])
    with pytest.raises(LockstepError, match='node /wall runs on wall time: its parameter use_sim_time'):
        lockstep.add(wall)
    wall.destroy_node()
    taken = Node('taken')
    executor = SingleThreadedExecutor()
    executor.add_node(taken)
    with pytest.raises(LockstepError, match='node /taken is in another executor'):
        lockstep.add(taken)
    executor.shutdown()
    taken.destroy_node()
    blinker.set_parameters([Parameter('use_sim_time', value=False)])
    with pytest.raises(LockstepError, match='node /blinker runs on wall time'):
        lockstep.run_for(1.0)


def test_arguments_of_a_wrong_kind_are_refused(lockstep):
    for use, words in (
        (
            lambda: lockstep.add(Blinker),
            'add takes a node, got the class Blinker; create one: add(Blinker(...))',
        ),
        (lambda: lockstep.add('blinker'), "add takes a node, got 'blinker'"),
        (
            lambda: lockstep.listen('twist', Twist),
            "listen takes a type and a topic, got 'twist' and the class Twist",
        ),
        (
            lambda: lockstep.publish(Vector3(), 'vector'),
            "publish takes a topic and a message, got an object of the class Vector3 and 'vector'",
        ),
        (
            lambda: lockstep.publish('vector', Vector3),
            "publish takes a topic and a message, got 'vector' and the class Vector3",
        ),
    ):
        with pytest.raises(LockstepError) as caught:
            use()
        assert str(caught.value) == words


def test_closed_lockstep_cannot_be_used(lockstep):
    blinker = lockstep.add(Blinker())
    lockstep.close()
    lockstep.close()
    for use in (
        lambda: lockstep.run_for(1.0),
        lambda: lockstep.step(),
        lambda: lockstep.add(blinker),
        lambda: lockstep.publish('a', Vector3()),
        lambda: lockstep.jump(1.0),
    ):
        with pytest.raises(LockstepError, match='this Lockstep is closed'):
            use()


def test_missing_topics_and_services_are_named(lockstep):
    lockstep.listen(Twist, 'cmd_vel')
    with pytest.raises(
        LockstepError, match='/cmd_vell has no subscription of type geometry_msgs/msg/Twist'
    ):
        lockstep.publish('cmd_vell', Twist())
    with pytest.raises(
        LockstepError, match=r'/cmd_vel is of type geometry_msgs/msg/Twist, not geometry_msgs/msg/V'
    ):
        lockstep.publish('cmd_vel', Vector3())
    with pytest.raises(
        LockstepError, match=r'/cmd_vel is of type geometry_msgs/msg/Twist, not geometry_msgs/msg/V'
    ):
        lockstep.listen(Vector3, 'cmd_vel')
    lockstep.add(Blinker())
    words = r'no service /nowhere of type std_srvs/srv/Trigger; services: /blinker/forget$'
    with pytest.raises(LockstepError, match=words):
        lockstep.call(Trigger, 'nowhere')
    with pytest.raises(
        LockstepError, match=r'/forget is of type std_srvs/srv/Trigger, not std_srvs/srv/Empty'
    ):
        lockstep.call(Empty, 'blinker/forget')


def test_two_nodes_of_one_name_are_refused(lockstep, robot_at):
    robot_at()
    with pytest.raises(LockstepError, match='another node has the name /virtual_robot: give one'):
        robot_at(x=1.0)
    robot_at(namespace='other')


def test_robot_without_such_a_parameter_is_refused(robot_at):
    with pytest.raises(TypeError, match=r"no parameter 'max_speed'; it has linear\.x\.max_velocity"):
        robot_at(max_speed=3.0)


def test_node_that_was_not_added_is_reported(lockstep):
    forgotten = Blinker('forgotten')
    forgotten.create_publisher(Vector3, 'words', 10).publish(Vector3())
    report = lockstep.report().splitlines()
    assert '  created, but not added to lockstep: /forgotten' in report
    assert '  /words: 1 from /forgotten, last at 1 s: Vector3()' in report
    lockstep.add(forgotten)
    assert 'forgotten' not in lockstep.report().replace('from /forgotten', '')


def test_a_guard_condition_is_refused_with_a_remedy(lockstep):
    node = Node('guarded')
    node.create_guard_condition(print)
    with pytest.raises(LockstepError, match=r'/guarded has a guard condition, .* use a timer'):
        lockstep.add(node)


def test_arguments_that_ros_would_pass_over_are_refused(lockstep):
    lockstep.close()
    with pytest.raises(LockstepError, match="args must begin with '--ros-args', got '-p'"):
        Lockstep(['-p', 'side:=0.5'])


def test_node_that_another_executor_spins_is_named(lockstep):
    with pytest.raises(LockstepError, match='node /blinker is in lockstep and cannot be spun'):
        rclpy.spin_once(lockstep.add(Blinker()), timeout_sec=0.0)
    waiting = lockstep.add(Blinker('waiting'))
    waiting.create_timer(0.1, lambda: rclpy.spin_until_future_complete(waiting, Future()))
    with pytest.raises(LockstepError, match='node /waiting is in lockstep and cannot be spun'):
        lockstep.run_for(1.0)


def test_use_within_a_callback_is_refused(lockstep):
    heard = lockstep.listen(Vector3, 'a')
    ticking = lockstep.node.create_timer(0.1, lambda: lockstep.publish('a', Vector3()))
    lockstep.run_for(0.2)
    assert len(heard) == 2
    lockstep.node.destroy_timer(ticking)
    node = lockstep.add(Node('other'))
    for call in (
        lambda: lockstep.run_for(0.5),
        lockstep.settle,
        lambda: lockstep.remove(node),
        lambda: lockstep.add(Node('new')),
    ):
        timer = lockstep.node.create_timer(0.1, call)
        with pytest.raises(LockstepError, match='a callback'):
            lockstep.run_for(0.1)
        lockstep.node.destroy_timer(timer)


def test_use_in_another_thread_is_refused(lockstep):
    failures = []

    def in_a_thread():
        try:
            lockstep.run_for(1.0)
        except LockstepError as error:
            failures.append(str(error))

    thread = threading.Thread(target=in_a_thread)
    thread.start()
    thread.join()
    assert failures == ['Lockstep must be created and used in the main thread']


def test_shutdown_of_rclpy_is_named(lockstep):
    lockstep.node.create_timer(0.1, rclpy.try_shutdown)
    with pytest.raises(LockstepError, match='rclpy was shut down'):
        lockstep.run_for(1.0)


def test_second_clock_is_named(lockstep):
    node = Node('rival')
    node.create_publisher(ClockMessage, '/clock', 10)
    with pytest.raises(LockstepError, match='node /rival publishes /clock, which only lockstep may do'):
        lockstep.add(node)


def test_missing_methods_of_the_executor_are_attribute_errors(lockstep):
    executor = lockstep.add(Node('asking')).executor
    assert not hasattr(executor, 'spin_once')
    assert getattr(executor, 'context', 'none') == 'none'
    assert hasattr(executor, 'create_task')
    with pytest.raises(LockstepError, match=r'a node in lockstep cannot call executor\.spin_once'):
        executor.spin_once()
