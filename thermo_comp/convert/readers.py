# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the choice of a log's reader by the file name: table, autopilot's log or bag."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from . import autopilot, bag, column_map
from .log import ForeignLog, naming, write_log

#: Keywords that `read_log` takes for each kind of file.
KEYWORDS: dict[str, tuple[str, ...]] = {
    'table': ('columns', 'rate_hz'),
    'log': ('imu', 'baro', 'allow_compensated'),
    'bag': ('topic', 'unit'),
}


def kind_of(path: Path) -> Literal['table', 'log', 'bag']:
    """Return the kind of a file: table, PX4 or ArduPilot log, or bag."""
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in ('.mcap', '.db3', '.bag'):
        return 'bag'
    return 'log' if suffix in ('.ulg', '.bin') else 'table'


def read_log(path: Path, **given: Any) -> ForeignLog:
    """
    Read a table, a PX4 or ArduPilot log, or a bag with topics or units other than the node's.

    Table: `columns` is the path of the column map (default: a guessed map), `rate_hz` the sample
    rate of a table without times. Log: `imu` and `baro` are the numbers of IMU and barometer, from
    0; `allow_compensated` accepts samples that the autopilot has corrected. Bag: `topic` maps
    ``imu``, ``board`` and ``case`` to topics, `unit` is the unit of acceleration of the Imu topic.

    Raises ValueError for a keyword of another kind of file, RecordingError for an unreadable file.
    """
    kind = kind_of(path)
    keywords = {name: value for name, value in given.items() if value is not None}
    for name in keywords:
        if name not in KEYWORDS[kind]:
            has = ', '.join(f'`{keyword}`' for keyword in KEYWORDS[kind])
            raise ValueError(f'`{name}` does not apply to a {kind}, which takes {has}')
    if others := keywords.get('topic', {}).keys() - {'imu', 'board', 'case'}:
        listed = ', '.join(sorted(others))
        raise ValueError(f'`topic` takes imu, board and case, which are converted, got {listed}')
    if keywords.keys() >= {'columns', 'rate_hz'}:
        raise ValueError('`rate_hz` does not apply if `columns` is given: the map states the rate')
    with naming(path):
        if kind == 'bag':
            return bag.bag_log(path, **keywords.pop('topic', {}), **keywords)
        if kind == 'log':
            return autopilot.read_autopilot(path, **keywords)
        if 'columns' in keywords:
            return column_map.table_log(path, column_map.load_column_map(keywords['columns']))
        guessed = column_map.guess_columns(path, **keywords)
        return replace(column_map.table_log(path, guessed), guessed=guessed)


@contextmanager
def as_bags(
    paths: Sequence[Path], on_log: Callable[[ForeignLog], None] = lambda _: None, **given: Any
) -> Iterator[list[Path]]:
    """Yield the bags, and a temporary bag for each table and log; call `on_log` with each log."""
    others = [path for path in paths if path.is_file() and kind_of(path) != 'bag']
    stated = [f'`{name}`' for name, value in given.items() if value]
    if stated and not others:
        raise ValueError(
            f'{" and ".join(stated)} are for tables and logs, but all given files are bags'
        )
    with TemporaryDirectory(prefix='thermo_comp-') as folder:
        bags = {}
        for number, path in enumerate(others):
            bags[path] = Path(folder) / str(number) / f'{path.name}.mcap'
            log = read_log(path, **given)
            on_log(log)
            write_log(log, bags[path])
        yield [bags.get(path, path) for path in paths]
