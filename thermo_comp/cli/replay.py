# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp replay``: a whole bag through the compensator, offline."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from . import options
from .output import Output

if TYPE_CHECKING:
    from ..replay import ReplayResult


def replay(
    bag: options.Bag,
    calibration: options.CalibrationFile,
    output: Annotated[
        Path, typer.Option('--output', '-o', help='*.mcap, a folder, *.csv or *.parquet.')
    ],
    keep_inputs: Annotated[
        bool, typer.Option('--keep-inputs', help='Copy the input messages beside the output.')
    ] = False,
    all_topics: Annotated[
        bool, typer.Option('--all-topics', help='Copy all other topics beside the output, too.')
    ] = False,
    serial: options.Serial = None,
    frame_id: Annotated[
        str, typer.Option(help="Frame of the output; empty keeps the input's.")
    ] = '',
    transition_time: Annotated[
        float | None, typer.Option(help='As the parameter of the node, in s.', min=0.0)
    ] = None,
    temperature_timeout: Annotated[
        float | None, typer.Option(help='As the parameter of the node, in s.')
    ] = None,
    case_timeout: Annotated[
        float | None, typer.Option(help='As the parameter of the node, in s.')
    ] = None,
    input_: options.InputOption = 'auto',
    topic: options.Topic = None,
    topics: options.TopicsFile = None,
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Correct a whole bag offline, with the values of the live node.

    Writes imu/data_raw (sensor_msgs/Imu), regime/dynamic (std_msgs/Bool)
    and regime/stamped (the same with its stamp); the log time of each
    message is its stamp. Or a table of the corrected samples, which leaves
    the other topics out.

    Example:
      thermo_comp replay flight.mcap -c unit42.yaml -o corrected.mcap
    """
    from ..files import bag_kind, check_output
    from ..online.status import CompensatorConfig
    from ..recording.table_out import TABLES
    from ..replay import replay as run
    from ..unit.calibration_file import load_calibration

    out = Output(as_json, quiet)
    given = {
        'transition_time_s': transition_time,
        'temperature_timeout_s': temperature_timeout,
        'case_timeout_s': case_timeout,
    }
    with options.usage_of():
        config = CompensatorConfig(**{k: v for k, v in given.items() if v is not None})
    kind = TABLES.get(output.suffix) or bag_kind(output, ', *.csv, *.parquet')
    if output.suffix in TABLES and (keep_inputs or all_topics):
        raise options.usage('--keep-inputs and --all-topics are for bags')
    check_output(output, kind, overwrite=force, others=[bag, calibration])
    with out.progress('replaying', total=1.0) as done:
        result = run(
            bag,
            load_calibration(calibration),
            output,
            config=config,
            topics=options.topics_of(topic, topics),
            input=input_,
            serial=serial,
            frame_id=frame_id,
            keep_inputs=keep_inputs,
            all_topics=all_topics,
            overwrite=force,
            progress=done,
        )
    _say(out, result)


def _say(out: Output, result: ReplayResult) -> None:
    from ..online.status import DROPPED

    counters = result.counters
    is_bad = out.told([result.info]) or not counters.n_out
    dropped = {
        name.removeprefix('n_').replace('_', ' '): n
        for name, n in asdict(counters).items()
        if name in DROPPED and n
    }
    out.line(f'{result.output}: {counters.n_out} of {counters.n_in} samples corrected')
    for reason, n in dropped.items():
        out.line(f'  left out, {reason}: {n}')
    start_ns = result.info.start_ns
    out.line(f'  regime flags: {result.n_flags}, switches: {max(len(result.switches) - 1, 0)}')
    for stamp_ns, is_dynamic in result.switches:
        name = 'dynamic' if is_dynamic else 'static'
        out.line(f'    {(stamp_ns - start_ns) * 1e-9:10.1f} s  {name}')
    out.json(
        {
            'output': result.output,
            'samples_in': counters.n_in,
            'samples_out': counters.n_out,
            'counters': asdict(counters),
            'flags': result.n_flags,
            'switches': [
                {'stamp_ns': stamp_ns, 'dynamic': is_dynamic}
                for stamp_ns, is_dynamic in result.switches
            ],
            'truncated': result.info.truncated,
        }
    )
    out.end(is_torn=is_bad)
