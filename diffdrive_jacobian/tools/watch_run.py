"""Show running robots on a page in the browser and steer them, or play a bag there."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from diffdrive_jacobian.errors import UserError
from diffdrive_jacobian.numerics.fields import between
from diffdrive_jacobian.signals import Signals
from diffdrive_jacobian.tools import _cli, _options, _page
from diffdrive_jacobian.tools._startup import long_lived

PROGRAM = 'watch_run'


def main(arguments: Sequence[str], signals: Signals) -> int:
    """Run the tool; return the exit code."""
    own, ros = _cli.split_arguments(arguments)
    parser = _parser()
    options = _cli.parse(parser, own)
    if options.bag is None and options.rate is not None:
        parser.error('--rate needs a BAG: running robots have their own time')
    if options.bag is not None and ros:
        parser.error('a BAG needs no ROS arguments')
    try:
        with _page.explaining_page_errors(options.port):
            return _bag(options, signals) if options.bag is not None else _nodes(options, ros, signals)
    except _page.PageError as error:
        return _cli.complain(PROGRAM, error, _cli.FAILED)


def _bag(options: argparse.Namespace, signals: Signals) -> int:
    from diffdrive_jacobian.bags.bag_reader import BagError
    from diffdrive_jacobian.live.bag_player import watch_bag

    print(f'reading {options.bag}', flush=True)
    try:
        watch_bag(
            options.bag,
            port=options.port,
            speed=options.rate or 1.0,
            signals=signals,
            ready=_page.announcing(options, notice=_page.PLAYS),
        )
    except BagError as error:
        return _cli.complain(PROGRAM, error)
    return _cli.DONE


def _nodes(options: argparse.Namespace, ros: Sequence[str], signals: Signals) -> int:
    with long_lived(), signals.ending_at_once():
        from diffdrive_jacobian.live.node import watch_nodes

    try:
        watch_nodes(
            ros_arguments=ros, port=options.port, signals=signals, ready=_page.announcing(options)
        )
    except UserError as error:
        return _cli.complain(PROGRAM, error)
    return _cli.DONE


def _rate(text: str) -> float:
    from diffdrive_jacobian.live.commands import MAX_WORLD_SPEED, MIN_WORLD_SPEED

    return _options.number_that(between(MIN_WORLD_SPEED, MAX_WORLD_SPEED))(text)


def _parser() -> _cli.Parser:
    parser = _cli.Parser(
        prog=PROGRAM,
        usage=f'{PROGRAM} [BAG] [options] [--ros-args ...]',
        description='Show running robots on a page in the browser: path, goal, wheels and the numbers '
        'of the Jacobian chain. The page also steers them. With BAG the page plays a recorded run. '
        'Ctrl-C ends. Exit code 0: ended by Ctrl-C; 1: the page cannot be served; 2: wrong arguments.',
    )
    _options.add_bag(parser, 'bag to play (default: show running robots)', nargs='?')
    _options.add_value(
        parser,
        '-r --rate',
        'X',
        'with BAG: how much faster than recorded it starts (default: 1.0)',
        kind=_rate,
    )
    _options.add_page(parser)
    return parser
