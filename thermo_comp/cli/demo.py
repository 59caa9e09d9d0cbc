# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``demo``: the main job on the sample bags, through the node over DDS."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import ThermoCompError
from ..topics import IMU_OUT, OUTPUTS, REGIME
from ..unit.gravity import STANDARD_GRAVITY
from . import shared_options as options
from .judge import tell_sections
from .output import Output
from .shared_options import option

if TYPE_CHECKING:
    from ..ros.player import PlayReport

#: Largest number of samples that the node may be behind the player; its middleware holds 5000.
_IN_FLIGHT = 2000
#: Time limit for discovery, and for the last messages [s]: a message that Fast DDS repeats is
#: 3 s late, on a busy machine several times.
_PATIENCE_S = 30.0
# Groups of the fits by column heading: one curve for both regimes; two curves; all groups that the
# evidence supports, as the node runs.
_MODELS = {'one set': ('curve',), 'two sets': ('curve', 'set'), 'node': None}


def demo(
    bags: Path | None = option('Folder of the sample bags.', metavar='DIR'),
    output: Path = option('Folder for the results.', Path('out'), '--out', '-o', metavar='DIR'),
    out: Output = options.out,
) -> None:
    """
    Run the main job on the sample bags, end to end.

    A bag that the fit did not use goes through the real path: player, DDS,
    the node, DDS, recorder.

    Example:
      thermo_comp demo --out out
    """
    options.require_ros()
    # Before the first import of ROS: restrict discovery to this machine.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    from ..api import fit
    from ..judging.evaluation import evaluate
    from ..replay import replay
    from ..report.evidence import evidence_of_bags
    from ..report.page import write_report
    from ..unit.calibration_file import save_calibration

    places = [bags] if bags else [Path('bags'), Path(__file__).parents[2] / 'bags']
    folder = next((one for one in places if (one / 'held_out.mcap').is_file()), None)
    if folder is None:
        raise ThermoCompError(
            f'no sample bags in {places[0]}: run it in a clone of the repository, or give --bags'
        )
    output.mkdir(parents=True, exist_ok=True)
    held_out, recorded, unit = folder / 'held_out.mcap', output / 'out.mcap', output / 'unit.yaml'
    fit_bags = sorted((folder / 'fit').glob('*.mcap'))

    models = {}
    with out.progress('fitting', total=len(_MODELS)) as done:
        for name, groups in _MODELS.items():
            models[name] = fit(fit_bags, gravity=STANDARD_GRAVITY, groups=groups)
            done(len(models))
    save_calibration(models['node'], unit)
    out.line(f'fitted {unit} from {len(fit_bags)} bags of {folder / "fit"}')
    with out.progress('playing') as done:
        played, counts = through_the_node(held_out, unit, recorded, progress=done)
    info, wall_s = played.info, played.duration_s
    bag_s, n_in = (info.end_ns - info.start_ns) * 1e-9, max(played.n_messages.values())
    n_out, n_flags = counts[IMU_OUT.name], counts[REGIME.name]
    out.line(
        f'played {held_out} through the node: {bag_s / 60.0:.0f} min in {wall_s:.1f} s, '
        f'{bag_s / wall_s:.0f} times real time'
    )
    out.line(
        f'messages in {n_in}, messages out {n_out}; regime flags {n_flags}; recorded {recorded}'
    )
    offline = replay(held_out, models['node'], output / 'offline.mcap', overwrite=True).output
    is_same = _messages(recorded) == _messages(offline)
    offline.unlink()
    out.line(f'node = offline replay, bit for bit: {"yes" if is_same else "NO"}')
    judged = [(name, models[name]) for name in reversed(_MODELS)]
    result = evaluate([held_out], judged, gravity=STANDARD_GRAVITY)
    out.line()
    tell_sections(out, result.judgements)
    out.line('one set: one cubic for both regimes; two sets: a cubic for each regime, as in the')
    out.line('paper; node: two sets and the thermal response that the fit selects')
    page, figures = output / 'report.html', output / 'figures'
    with out.progress('drawing', total=None):
        evidence = evidence_of_bags(result.bags, models['node'], gravity=STANDARD_GRAVITY)
        write_report(evidence, page, figures=figures)
    figure = next(figures.glob('*gravity.png'))
    out.line()
    out.line(f'figure {figure}, certificate {page}')
    out.end(
        messages_in=n_in,
        messages_out=n_out,
        is_equal_to_offline=is_same,
        bag_s=bag_s,
        wall_s=wall_s,
        judgements={name: one.facts() for name, one in result.judgements.items()},
        recorded=recorded,
        figure=figure,
    )
    if not is_same or n_out != n_in:
        raise ThermoCompError('the node lost messages or differs from the offline replay')


def through_the_node(
    bag: Path,
    calibration: Path,
    output: Path,
    *node_args: str,
    progress: Callable[[float], None] = lambda _: None,
) -> 'tuple[PlayReport, dict[str, int]]':
    """
    Play a bag into the node and record what it publishes, without loss.

    Returns the player's report and the number of recorded messages by topic. Differences to a
    robot: the QoS is reliable with unlimited depth, and the player waits for the node.
    """
    from ..ros.listener import Recorder
    from ..ros.node import node_in_thread
    from ..ros.player import lossless, opened_player
    from ..ros.waitloop import wait_until
    from ..unit.calibration_file import load_calibration

    namespace = f'/demo_{os.getpid()}'
    ros_args = ['-r', f'__ns:={namespace}', '-r', f'/diagnostics:={namespace}/diagnostics']
    settings = lossless(namespace, ['board', *load_calibration(calibration).sensors])
    settings += ['-p', f'calibration_file:={calibration}', *node_args]
    settings += ['--log-level', f'{namespace[1:]}.thermo_comp:=WARN']
    with (
        node_in_thread(*ros_args, *settings) as node,
        Recorder(output, ros_args=ros_args, overwrite=output.exists()) as recorder,
        opened_player(bag, 0.0, ros_args=ros_args) as player,
    ):

        def is_joined() -> bool:
            """Whether every topic has discovered both ends."""
            heard = {one.topic_name for one in node.node.subscriptions}
            sent = {one.topic_name for one in player.node.publishers}
            results = {f'{namespace}/{topic.name}' for topic in OUTPUTS}
            return (
                recorder.has_publishers
                and heard.isdisjoint(player.unheard())
                and all(
                    one.get_publisher_count()
                    for one in node.node.subscriptions
                    if one.topic_name in sent
                )
                and all(
                    one.get_subscription_count()
                    for one in node.node.publishers
                    if one.topic_name in results
                )
            )

        wait_until(is_joined, _PATIENCE_S)
        played = player.run(
            progress, lambda n: wait_until(lambda: n - node.counts()[0] <= _IN_FLIGHT, _PATIENCE_S)
        )
        n_sent = max(played.n_messages.values())

        def is_complete() -> bool:
            n_in, n_out, n_flags = node.counts()
            return n_in == n_sent and [*recorder.counts.values()] == [n_out, n_flags, n_flags]

        wait_until(is_complete, _PATIENCE_S)
        return played, recorder.counts


def _messages(path: Path) -> list[tuple[int, bytes]]:
    """Read the corrected samples of a bag: the time and the bytes of each."""
    from ..recording.reader import open_recording
    from ..recording.topics import Topics

    with open_recording(path, Topics(imu=IMU_OUT.name, input='imu'), require=['accel']) as bag:
        return [
            one
            for block in bag.blocks(raw=True)
            for one in zip(block.log_ns['accel'].tolist(), block.raw['accel'], strict=True)
        ]
