# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns ``thermo_comp convert``: other people's logs into bags."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from . import options
from .output import Output

if TYPE_CHECKING:
    from ..convert import ConversionReport, ForeignLog
    from ..convert.log import Finding

_BAGS = {'.mcap', '.db3', '.bag'}


def convert(
    log: Annotated[
        Path,
        typer.Argument(
            help='Table (.csv, .tsv, .txt, .parquet), PX4 (.ulg) or ArduPilot log (.bin), or bag.',
            metavar='FILE',
        ),
    ],
    output: Annotated[
        Path, typer.Option('--output', '-o', help='Bag to write; *.mcap makes a bare file.')
    ],
    columns: Annotated[
        Path | None,
        typer.Option(help='Column map of a table (YAML): what is where, in which unit.'),
    ] = None,
    rate_hz: options.TableRate = None,
    imu: Annotated[int | None, typer.Option(help='IMU of a log, counted from 0.')] = None,
    baro: Annotated[
        int | None, typer.Option(help='Barometer of a log, for the case temperature.')
    ] = None,
    allow_compensated: Annotated[
        bool, typer.Option(help='Take a log that INS_TCAL or TC_A has corrected.')
    ] = False,
    topic: options.Topic = None,
    topics: options.TopicsFile = None,
    unit: Annotated[
        Literal['m/s^2', 'g', 'mg'], typer.Option(help='What the Imu topic of a bag is in.')
    ] = 'm/s^2',
    force: options.Force = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """
    Make a bag of a table of numbers or of an autopilot's log.

    A table needs a column map: which column is what, in which unit; what the
    sensor reads at rest must agree with it. config/columns has examples. One
    of [t] ax ay az [wx wy wz] without headings needs none. Of a PX4 or
    ArduPilot log the IMU's own temperature becomes the board's, the
    barometer's the case's. Of a bag the thermometer beside the Imu topic
    becomes the board's, one beside a barometer the case's.

    Example:
      thermo_comp convert log.csv --columns map.yaml -o unit42
      thermo_comp convert flight.ulg --imu 1 -o unit43
    """
    from ..convert import bag_log, write_log
    from ..files import bag_kind, check_output

    out = Output(as_json, quiet)
    read_too = [] if columns is None else [columns]
    check_output(output, bag_kind(output), overwrite=force, others=[log, *read_too])
    names = options.named_topics(topic, topics)
    if _is_bag(log):
        if not names.keys() <= {'imu', 'board', 'case'}:
            raise options.usage('--topic: of a bag, imu, board and case are converted')
        for_logs = (columns, rate_hz, imu, baro, allow_compensated or None)
        if any(one is not None for one in for_logs):
            raise options.usage(
                '--columns and --rate-hz are for tables, --imu, --baro and --allow-compensated '
                'for logs; a bag has --topic'
            )
        read: Callable[[], ForeignLog] = partial(
            bag_log, log, names.get('imu'), names.get('board'), names.get('case'), unit
        )
    else:
        if names or unit != 'm/s^2':
            raise options.usage('--topic and --unit are for bags')
        read = _reader(out, log, columns, rate_hz, imu, baro, allow_compensated)
    with out.progress('converting', total=1.0) as done:
        report = write_log(read(), output, force, done)
    say(out, report)
    if report.missing:
        out.note(f'{log}: {report.missing}')
    out.end(is_torn=bool(report.missing))


def _is_bag(path: Path) -> bool:
    return path.is_dir() or path.suffix.lower() in _BAGS


@contextmanager
def as_bags(
    out: Output, paths: Sequence[Path], columns: Path | None, rate_hz: float | None
) -> Iterator[list[Path]]:
    """Let tables and logs take part as bags, for as long as it lasts."""
    from ..convert import write_log

    others = [path for path in paths if path.is_file() and not _is_bag(path)]
    if (columns or rate_hz) and not others:
        raise options.usage('--columns and --rate-hz are for tables, and there is none')
    with TemporaryDirectory(prefix='thermo_comp-') as folder:
        bags = {}
        for number, path in enumerate(others):
            bags[path] = Path(folder) / str(number) / f'{path.name}.mcap'
            bags[path].parent.mkdir()
            write_log(_reader(out, path, columns, rate_hz)(), bags[path])
        yield [bags.get(path, path) for path in paths]


def _reader(
    out: Output,
    log: Path,
    columns: Path | None = None,
    rate_hz: float | None = None,
    imu: int | None = None,
    baro: int | None = None,
    allow_compensated: bool = False,
) -> Callable[[], ForeignLog]:
    """Tell the format of a table or log by its name, and refuse options that it has no use for."""
    from ..convert import (
        foreign_log,
        guess_columns,
        load_column_map,
        read_dataflash,
        read_ulog,
        spoken_columns,
        table_log,
    )

    suffix = log.suffix.lower()
    is_log = suffix in ('.ulg', '.bin')
    if is_log and (columns is not None or rate_hz is not None):
        raise options.usage(f'a {suffix} log needs no --columns and no --rate-hz')
    if allow_compensated and not is_log:
        raise options.usage('--allow-compensated is for PX4 and ArduPilot logs (.ulg, .bin)')
    if is_log:
        read = read_ulog if suffix == '.ulg' else read_dataflash
        return lambda: foreign_log(read(log), imu, baro, allow_compensated)
    if imu is not None or baro is not None:
        raise options.usage('--imu and --baro are for PX4 and ArduPilot logs (.ulg, .bin)')
    if columns is not None and rate_hz is not None:
        raise options.usage('--rate-hz: a column map says that')
    if columns is None and suffix in ('.parquet', '.pq'):
        raise options.usage('a Parquet table needs --columns MAP')
    if columns is not None:
        return partial(table_log, log, load_column_map(columns))
    guessed = guess_columns(log, rate_hz)
    out.line(f'{log}: taken as {spoken_columns(guessed)}; --columns says otherwise')
    return partial(table_log, log, guessed)


def say(out: Output, report: ConversionReport) -> None:
    """Print the account of a conversion."""
    from ..convert.log import SLOW_HZ

    out.line(
        f'{report.source}: {report.rows} rows, {report.duration_s:.1f} s '
        f'at {report.rate_hz:.4g} Hz'
    )
    topic = 'accel/counts' if report.input == 'counts' else 'imu/uncompensated'
    out.line(f'{report.output}:')
    out.line(f'  {report.accel_messages:8} {topic}')
    out.line(f'  {report.board_messages:8} temperature/board')
    out.line(f'  {report.case_messages:8} temperature/case')
    for name, count in report.further_messages.items():
        out.line(f'  {count:8} temperature/{name}')
    out.line(f'unit: {report.unit}; {report.believed}')
    if report.rate_hz < SLOW_HZ:
        out.line(
            f'{report.rate_hz:.3g} Hz: good for soaks of minutes; rests by hand are too short for '
            'it, and it sees neither vibration nor a knock between two samples'
        )
    if report.hint:
        out.line(report.hint)
    _say_finding(out, 'rows left out, too short', report.short_rows)
    _say_finding(out, 'rows left out, no number', report.non_numeric)
    _say_finding(out, 'rows left out, stamp before 1970 or after 2038', report.out_of_range)
    _say_finding(out, 'rows clipped, kept', report.clipped)
    _say_finding(out, 'rows whose time goes back, kept', report.backwards)
    _say_finding(out, 'rows whose time stands still, kept', report.repeated)
    if report.stillness.moving_ns:
        out.line('moved or shaken, not at rest:')
        for first, last in report.stillness.moving_ns:
            begin, end = ((t - report.start_ns) * 1e-9 for t in (first, last))
            out.line(f'  {begin:9.1f} .. {end:.1f} s')
    out.json({name: getattr(report, name) for name in report.__dataclass_fields__})


def _say_finding(out: Output, what: str, finding: Finding) -> None:
    if finding.count:
        lines = ', '.join(map(str, finding.lines))
        more = ', ...' if finding.count > len(finding.lines) else ''
        out.line(f'{what}: {finding.count}' + (f' (line {lines}{more})' if lines else ''))
