# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the commands for a single bag: ``info`` (also for a calibration), ``replay``, ``play``."""

from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..files import bag_kind, check_output
from ..online.status import DROPPED, CompensatorConfig
from ..text import counted
from . import shared_options as options
from .output import Cell, Output, micro_g, picked
from .shared_options import argument, option

if TYPE_CHECKING:
    from ..unit.calibration import Calibration

_BAG = argument('Recording: rosbag2 directory, .mcap, .db3 or ROS 1 .bag.', metavar='BAG')
#: Texts for the compensator's counters of samples that are left out of the output.
_LEFT_OUT = {
    'n_not_finite': (
        'samples that are not finite, or marked as without an acceleration '
        '(linear_acceleration_covariance[0] = -1)'
    ),
    'n_saturated': 'samples at the full scale of the calibration',
    'n_out_of_order': 'samples whose stamp is not after all earlier stamps, or far in the future',
    'n_no_temperature': 'samples before the first board temperature',
    'n_stale': 'samples with a board temperature older than --temperature-timeout',
    'n_stuck': 'samples that repeat earlier values for too long, or are 0 on all axes',
    'n_too_fast': 'samples at shorter intervals than the conversion cycle of the calibration',
    'n_refuted': 'samples while |f| at rest differs too much from gravity',
    'n_unsound': 'samples whose correction is not finite',
}


def info(
    path: Path = argument('Bag or calibration file.', metavar='BAG|YAML'),
    topics: Any = options.reading_part,
    out: Output = options.out,
) -> None:
    """
    Describe a bag or a calibration.

    For a bag, prints topics, rate, range of temperatures, ramps and gaps, and
    whether a fit can use the bag; for a calibration, the unit, the sets of
    coefficients with their ranges, the residuals and the nonlinear terms.

    Example:
      thermo_comp info chamber.mcap
    """
    from ..recording.overview import survey_recording

    if path.suffix in ('.yaml', '.yml'):
        _print_calibration(out, path)
        return
    with out.progress(f'reading {path.name}') as done:
        survey = survey_recording(path, topics, done)
    bag, thermometers = survey.info, survey.thermometers
    out.line(f'{path}: {bag.storage}, {bag.n_messages} messages')
    for key, value in bag.metadata.items():
        if key in ('serial', 'converted_from', 'corrected_from', 'simulated_by'):
            out.line(f'  {key.replace("_", " ")}: {value}')
    rows = sorted((name, kind, count) for name, (kind, count) in bag.topics.items())
    out.table(('topic', 'type', 'messages'), rows)
    if survey.n:
        out.line(
            f'{survey.n} samples of {bag.input}, {survey.rate_hz:.4g} Hz, '
            f'{survey.duration_s:.1f} s; {counted(survey.n_still, "still interval")}, '
            f'{survey.still_s:.1f} s'
        )
    if bag.chosen:
        out.line(bag.chosen)
    if thermometers:
        facts = 'rate_hz lowest highest steepest_heating_k_min steepest_cooling_k_min'
        out.table(
            ('sensor', 'Hz', 'min degC', 'max degC', 'max K/min', 'min K/min'),
            [(name, *picked(readings, facts).values()) for name, readings in thermometers.items()],
        )
    out.points(survey.findings)
    if not survey.findings:
        out.line('a fit can use this bag, together with bags of other positions')
    out.end(
        int(bool(bag.truncated)),
        path=path,
        **picked(bag, 'storage truncated metadata input chosen'),
        topics={name: {'type': kind, 'messages': n} for name, (kind, n) in bag.topics.items()},
        samples=survey.n,
        still_intervals=survey.n_still,
        board=thermometers.get('board'),
        case=thermometers.get('case'),
        **picked(survey, 'rate_hz duration_s still_s thermometers findings'),
    )


def _print_calibration(out: Output, path: Path) -> None:
    from ..field.series import last_rest
    from ..online.trial import tried
    from ..unit.calibration_file import load_calibration

    calibration = load_calibration(path)
    tried(calibration, path)
    unit, provenance = calibration.unit, calibration.provenance
    n_logs = sum(bool(last_rest(source)) for source in provenance.sources)
    data = counted(len(provenance.sources) - n_logs, 'bag')
    if n_logs:
        data += f' and {counted(n_logs, "rest log")}'
    out.line(f'{path}: unit {unit.serial}, input {unit.input}, full scale {unit.full_scale:g}')
    out.line(
        f'  fitted {provenance.created or "at an unknown time"} by thermo_comp '
        f'{provenance.tool_version or "?"} from {data}, '
        f'model {provenance.model or "?"}'
    )
    out.line(
        f'  local gravity {calibration.gravity_m_s2:.6g} m/s^2, '
        f'reference temperature {calibration.reference_temperature_c:g} degC'
    )
    out.table(
        ('axis', 'scale factor', 'bias', 'bias ug'),
        [
            (k, f'{a.scale_factor:.8g}', f'{a.bias:.6g}', micro_g(a.bias / a.scale_factor))
            for k, a in zip('xyz', calibration.axes, strict=True)
        ],
    )
    out.table(
        ('set', 'degC', 'K/min', 'bias(t)', 'scale(t)'),
        [
            (
                name,
                '{:.1f} .. {:.1f}'.format(*set_.temperature_range_c),
                '{:.2f} .. {:.2f}'.format(*set_.rate_range_k_min),
                *(set_.x.bias_function.kind, set_.x.scale_function.kind),
            )
            for name, set_ in zip(('static', 'dynamic'), calibration.regime_sets(), strict=True)
        ],
    )
    if provenance.residuals:
        out.table(
            ('section', 'windows', 'raw', 'RMS', 'max', 'left out', 'left-out drift'),
            [
                (
                    *(n.section, n.n_windows),
                    *map(micro_g, (n.raw_rms_m_s2, n.rms_m_s2, n.max_m_s2)),
                    *(x and micro_g(x) for x in (n.left_out_rms_m_s2, n.left_out_drift_m_s2)),
                )
                for n in provenance.residuals
            ],
            title='|f| - g in the fit and on left-out data; drift of an axis on left-out data; ug',
        )
    print_nonlinearity(out, calibration)
    out.points(provenance.notes)
    out.end(path=path, calibration=calibration)


def print_nonlinearity(out: Output, calibration: 'Calibration') -> None:
    """Print the nonlinear terms of a calibration, if the fit estimated nonlinearity."""
    from ..unit.prediction import nonlinear_coefficients

    if calibration.nonlinearity is None:
        return
    rows: list[tuple[Cell, ...]] = []
    for coefficient in nonlinear_coefficients(calibration):
        axes = zip(coefficient.value.tolist(), coefficient.sd.tolist(), strict=True)
        cells = [f'{value:.4g}' + f' +- {sd:.2g}' * isfinite(sd) for value, sd in axes]
        rows.append((coefficient.name, coefficient.unit, *cells))
    terms = calibration.nonlinearity.terms
    loss = ', '.join(f'{term.kind} {term.log_evidence_change:.1f}' for term in terms) or 'no term'
    low, high = calibration.nonlinearity.force_range_m_s2
    out.table(
        ('coefficient', 'unit', 'x', 'y', 'z'),
        rows,
        title=f'nonlinearity, |f| of {low:.4g} .. {high:.4g} m/s^2; loss of log evidence '
        f'without a term: {loss}',
    )


def replay(
    bag: Path = _BAG,
    calibration: Path = option('Calibration of the unit (YAML).', ..., '-c'),
    output: Path = option(
        'Output: *.mcap or a folder for a bag, *.csv or *.parquet for a table.', ..., '-o'
    ),
    keep_inputs: bool = option('Also copy the input topics.', False),
    all_topics: bool = option('Also copy all topics of the bag.', False),
    serial: str | None = options.SERIAL,
    frame_id: str = option('frame_id of the output messages; default: frame_id of the input.', ''),
    transition_time: float = option(
        'Time in s over which the coefficients are blended after a switch of the regime '
        '(parameter transition_time of the node); 0: no blending.',
        CompensatorConfig.transition_time_s,
        min=0.0,
    ),
    temperature_timeout: float = option(
        'Largest age of the board temperature, in s, at which samples are corrected (parameter '
        'temperature_timeout of the node).',
        CompensatorConfig.temperature_timeout_s,
    ),
    case_timeout: float = option(
        'Age of the case temperature, in s, above which the regime follows from the board '
        'temperature alone (parameter case_timeout of the node).',
        CompensatorConfig.case_timeout_s,
    ),
    topics: Any = options.reading,
    force: bool = options.FORCE,
    out: Output = options.out,
) -> None:
    """
    Correct a whole bag offline; the output equals the node's output for this bag.

    Writes imu/data_raw (sensor_msgs/Imu), regime/dynamic (std_msgs/Bool)
    and regime/stamped (the regime with its stamp); the log time of each
    message is its stamp. A table contains the corrected samples only.

    Example:
      thermo_comp replay flight.mcap -c unit42.yaml -o corrected.mcap
    """
    from ..recording.writer import TABLES
    from ..replay import replay as run
    from ..unit.calibration_file import load_calibration

    with options.usage_of():
        config = CompensatorConfig(transition_time, temperature_timeout, case_timeout)
    kind = TABLES.get(output.suffix) or bag_kind(output, ', *.csv, *.parquet')
    if output.suffix in TABLES and (keep_inputs or all_topics):
        raise options.usage(
            f'--keep-inputs and --all-topics need a bag as --output, got the table {output}'
        )
    check_output(output, kind, overwrite=force, others=[bag, calibration])
    with out.progress('replaying') as done:
        result = run(
            bag,
            load_calibration(calibration),
            output,
            config=config,
            topics=topics,
            serial=serial,
            frame_id=frame_id,
            keep_inputs=keep_inputs,
            all_topics=all_topics,
            overwrite=force,
            progress=done,
        )
    info, counters = result.info, result.counters
    out.sources([(info.path, info.chosen, info.truncated)])
    for note in result.notes:
        out.note(f'{info.path}: {note}')
    counts = asdict(counters)
    out.line(f'{output}: {counters.n_out} of {counters.n_in} samples corrected')
    for name, count in counts.items():
        if name in DROPPED and count:
            out.line(f'  left out, {_LEFT_OUT[name]}: {count}')
    n_switches = max(len(result.switches) - 1, 0)
    out.line(f'  regime flags: {result.n_flags}, switches of the regime: {n_switches}')
    for at, flag in result.switches:
        regime = 'dynamic' if flag else 'static'
        out.line(f'    {(at - info.start_ns) * 1e-9:10.1f} s  {regime}')
    out.end(
        int(not counters.n_out),
        output=output,
        samples_in=counters.n_in,
        samples_out=counters.n_out,
        counters=counts,
        flags=result.n_flags,
        switches=[{'stamp_ns': at, 'dynamic': flag} for at, flag in result.switches],
        truncated=info.truncated,
        notes=result.notes,
    )


def play(
    context: typer.Context,
    bag: Path = _BAG,
    rate: float = option(
        'Speed relative to real time; 0: as fast as reliable subscribers receive messages. A '
        'subscriber loses messages if it processes them more slowly than they arrive.',
        1.0,
        min=0.0,
    ),
    wait: float = option('Longest wait until every topic has a subscriber, in s.', 10.0, min=0.0),
    topics: Any = options.reading,
    out: Output = options.out,
) -> None:
    """
    Play a bag onto the live topics of the node, with /clock.

    The topics are published as accel/counts (or imu/uncompensated),
    temperature/board and temperature/case, whatever their names in the bag;
    arguments after --ros-args remap them. The playback ends when every reliable
    subscriber has received all messages. For topics that the node does not
    read, and for pauses and loops, use ros2 bag play.

    Example:
      thermo_comp play chamber.mcap --rate 20
      thermo_comp play chamber.mcap --ros-args -r __ns:=/imu0
    """
    if not rate < float('inf'):
        raise options.usage('--rate must be finite; 0 plays as fast as the subscribers receive')
    options.require_ros()
    from ..ros.player import play as run

    with out.progress('playing') as done:
        report = run(
            bag, rate=rate, wait_s=wait, topics=topics, ros_args=context.obj, progress=done
        )
    for name in report.unheard:
        out.note(f'the topic {name} had no subscriber: its messages were not received')
    for name in report.lossy:
        out.note(f'the topic {name} has a best-effort subscriber, which may have lost messages')
    out.sources([(bag, report.info.chosen, report.info.truncated)])
    out.table(('topic', 'messages'), sorted(report.n_messages.items()))
    out.line(f'played in {report.duration_s:.1f} s')
    out.end(messages=report.n_messages, **picked(report, 'duration_s unheard lossy'))
