"""Start-up: time and CPU time from the start of a process to the first odometry that it publishes.

Beside the console script `virtual_robot` as it is installed: a script of a bare node (odometry at 50 Hz,
`rclpy.spin`). Both are run in the same way by this file, `python start_up.py SCRIPT`: it wraps rclpy's
`Publisher.publish`, prints the time of the first message on odom (the monotonic clock is the same for
all processes) and the CPU time of the process until then, and removes the wrapper. That imports rclpy a
moment earlier and costs two calls; an observer in another process would add the time of discovery.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from table import Goal, Row, interleave

PATIENCE = 30.0
"""A process is killed if it says nothing, or does not end, for this long (s)."""
BARE = """
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node


class Robot(Node):
    def __init__(self):
        super().__init__('bare')
        self.odom = self.create_publisher(Odometry, 'odom', 10)
        self.create_timer(0.02, self.tick)

    def tick(self):
        message = Odometry()
        message.header.stamp = self.get_clock().now().to_msg()
        self.odom.publish(message)


rclpy.init()
rclpy.spin(Robot())
"""
SCRIPTS = {'our': str(Path(sys.executable).with_name('virtual_robot')), 'bare': ''}


def observed(script: str) -> None:
    """Run a script in this process; print when it first published odometry, and its CPU time (ns)."""
    from rclpy.publisher import Publisher

    publish = Publisher.publish

    def first(self: Publisher, message: object) -> None:
        publish(self, message)
        if self.topic_name == '/odom':
            print(time.monotonic_ns(), time.process_time_ns(), flush=True)
            Publisher.publish = publish

    Publisher.publish = first
    sys.argv = [script or 'bare']
    source = Path(script).read_text() if script else BARE
    exec(compile(source, sys.argv[0], 'exec'), {'__name__': '__main__'})


def start(side: str) -> tuple[float, float]:
    """Start a process; return the time and the CPU time until the first odometry (ms)."""
    # A domain of its own: nothing else is discovered.
    domain = str(os.getpid() % 100 + 1)
    environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DOMAIN_ID': domain}
    command = [sys.executable, __file__, SCRIPTS[side]]
    begun = time.monotonic_ns()
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        line = _first_line(process)
        process.terminate()
        process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
        process.communicate()
    if not line:
        raise RuntimeError(f'no odometry from {command} within {PATIENCE:g} s')
    published, cpu = map(int, line.split())
    return (published - begun) * 1e-6, cpu * 1e-6


def _first_line(process: subprocess.Popen) -> str:
    """Wait for a line; a process that writes none is killed, which ends its output."""
    assert process.stdout is not None
    killer = threading.Timer(PATIENCE, process.kill)
    killer.start()
    try:
        return process.stdout.readline()
    finally:
        killer.cancel()


def rows(quick: bool) -> list[Row]:
    """Start both sides in turn."""
    figures = interleave(SCRIPTS, 3 if quick else 15, start)
    quantities = (
        'process start to first odometry (ms)',
        'CPU time until the first odometry (ms)',
    )
    return [
        Row(
            group='start-up',
            ours='virtual_robot, the console script',
            beside='bare node, rclpy.spin',
            quantity=quantity,
            pairs=[
                (our[number], bare[number])
                for our, bare in zip(figures['our'], figures['bare'], strict=True)
            ],
            goal=Goal(1.1),
        )
        for number, quantity in enumerate(quantities)
    ]


if __name__ == '__main__':
    observed(sys.argv[1])
