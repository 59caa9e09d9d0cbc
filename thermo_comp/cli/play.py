# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp play``: a bag onto the live topics of the node."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Annotated

import typer

from ..errors import ThermoCompError
from . import options
from .output import Output


def play(
    context: typer.Context,
    bag: options.Bag,
    rate: Annotated[
        float,
        typer.Option(help='Seconds of the bag per second; 0 = as fast as it is taken.', min=0.0),
    ] = 1.0,
    wait: Annotated[
        float, typer.Option(help='Longest wait for a subscriber on every topic, in s.', min=0.0)
    ] = 10.0,
    input_: options.InputOption = 'auto',
    topic: options.Topic = None,
    topics: options.TopicsFile = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Play a bag onto the live topics of the node, with /clock.

    Whatever the topics are called in the bag, they go out as accel/counts
    (or imu/uncompensated), temperature/board and temperature/case; remap
    them after --ros-args. It ends when every reliable subscriber has got
    everything. For other topics, pauses and loops there is ros2 bag play.

    Example:
      thermo_comp play chamber.mcap --rate 20
      thermo_comp play chamber.mcap --ros-args -r __ns:=/imu0
    """
    if not rate < float('inf'):
        raise options.usage('--rate must be finite; 0 is as fast as it is taken')
    require_ros()
    from ..ros.player import play as run

    out = Output(as_json, quiet)
    with out.progress('playing', total=1.0) as done:
        report = run(
            bag,
            rate=rate,
            wait_s=wait,
            topics=options.topics_of(topic, topics),
            input=input_,
            ros_args=context.obj or (),
            progress=done,
        )
    for name in report.unheard:
        out.note(f'nobody listened to {name}')
    for name in report.lossy:
        out.note(f'{name} has a best-effort subscriber, which can lose messages')
    out.chosen([(bag, report.chosen)])
    if report.missing:
        out.note(f'{bag}: {report.missing}')
    out.table(('topic', 'messages'), sorted(report.n_messages.items()))
    out.line(f'played in {report.duration_s:.1f} s')
    out.json(
        {
            'messages': report.n_messages,
            'duration_s': report.duration_s,
            'unheard': report.unheard,
            'lossy': report.lossy,
        }
    )
    out.end(is_torn=bool(report.missing))


def require_ros() -> None:
    """Raise ThermoCompError, which says what to do, where there is no ROS."""
    if find_spec('rclpy') is None:
        raise ThermoCompError(
            f'this command needs ROS 2 for {sys.executable}: source its setup file, or '
            "pip install 'thermo_comp[ros]'"
        )
