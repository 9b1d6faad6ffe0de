"""Recording and replaying: messages lost, CPU per message, and how late replayed messages come.

A child publishes Odometry on six topics at 5,000 messages per second for 30 s, another records them.
Then a bag of 500 messages per second is replayed to a reader; the replayer itself tells how late it
published each. Run: `python test/benchmark/bags.py [--seconds S]`.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

TOPICS = [f'topic_{index}' for index in range(6)]
RECORD = (
    'import sys; from diffdrive_jacobian.tools.entry_points import record_run; sys.exit(record_run())'
)


def publish(rate, seconds):
    """Publish at an even rate once everybody listens; the messages are numbered."""
    import rclpy
    from nav_msgs.msg import Odometry
    from rclpy.serialization import serialize_message

    rclpy.init()
    node = rclpy.create_node('publisher')
    publishers = [node.create_publisher(Odometry, topic, 5000) for topic in TOPICS]
    while not all(one.get_subscription_count() for one in publishers):
        time.sleep(0.05)
    data = serialize_message(Odometry())
    count, begun, sent = int(rate * seconds), time.perf_counter(), 0
    while sent < count:
        due = min(count, int((time.perf_counter() - begun) * rate))
        while sent < due:
            publishers[sent % len(publishers)].publish(data)
            sent += 1
        time.sleep(0.001)
    for one in publishers:
        one.wait_for_all_acked()
    rclpy.shutdown()


def record(seconds, rate, directory):
    """Give how many of the messages came, and the recorder's CPU per message (us)."""
    from rosbags.rosbag2 import Reader

    bag = directory / f'bag_{rate}'
    recorder = subprocess.Popen([sys.executable, '-c', RECORD, *TOPICS, '-o', str(bag)])
    publisher = subprocess.Popen([sys.executable, __file__, '--publish', str(rate), str(seconds)])
    publisher.wait(timeout=seconds * 3 + 30)
    between = resource.getrusage(resource.RUSAGE_CHILDREN)
    time.sleep(1.0)
    recorder.terminate()
    recorder.wait(timeout=120)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = (after.ru_utime + after.ru_stime) - (between.ru_utime + between.ru_stime)
    with Reader(bag) as reader:
        return reader.message_count, cpu / reader.message_count * 1e6, bag


def replay(bag):
    """Return the median and the 99th percentile of the delays of the messages (us)."""
    import numpy as np
    from nav_msgs.msg import Odometry
    from rclpy.node import Node

    from diffdrive_jacobian.bags.bag_reader import open_bag
    from diffdrive_jacobian.recording import Playback, Replayer
    from diffdrive_jacobian.ros.runner import ros_context, running

    playback = Playback(names=None)
    with (
        open_bag(bag) as reader,
        ros_context(['benchmark']) as context,
        running(context, isolated=False) as runner,
    ):
        listener = runner.add(lambda: Node('listener', context=context))
        for topic in TOPICS:
            listener.create_subscription(Odometry, topic, lambda _: None, 100, raw=True)
        player = runner.add(lambda: Replayer(reader, playback, context=context))
        delays = []

        def timed(publish):
            def send(data):
                delays.append(time.monotonic_ns() - player._due(player._next[1]))
                publish(data)

            return send

        for publisher in player._publishers_by_connection.values():
            publisher.publish = timed(publisher.publish)
        player.begin()
        runner.spin(lambda: player.done)
        return np.percentile(delays, (50, 99)) / 1e3


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=30.0)
    parser.add_argument('--publish', nargs=2, type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.publish:
        publish(*options.publish)
        return
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(os.getpid() % 100 + 1)
    with tempfile.TemporaryDirectory() as directory:
        for rate in (5000, 500):
            count, cpu, bag = record(options.seconds, rate, Path(directory))
            sent = int(rate * options.seconds)
            print(f'{rate} per second: {sent - count} of {sent} lost, {cpu:.0f} us of CPU per message')
        median, late = replay(bag)
        print(f'replayed at 500 per second: median {median:.0f} us late, p99 {late:.0f} us')


if __name__ == '__main__':
    main()
