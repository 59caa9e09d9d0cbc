# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns the command ``record``: records a test, a bag per position, and shows missing data."""

import re
import shlex
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..errors import RecordingError, ThermoCompError
from ..text import counted
from ..unit.gravity import STANDARD_GRAVITY, ug_text
from . import shared_options as options
from .output import Cell, Output, micro, picked
from .shared_options import argument, option

if TYPE_CHECKING:
    from ..recording.growing import News, PositionBags
    from ..typing import Floats
    from .acquisition import Account, Acquisition, Position

_COLUMNS = ('no', 'up x', 'y', 'z', 'min', 'degC', 'K/min', 'state')


def record(
    context: typer.Context,
    output: Path = option('Folder of the bags; bags already in it belong to the test.', ..., '-o'),
    bag: Path | None = argument(
        'Bag to read instead of live topics, also while it is written.', None, metavar='[BAG]'
    ),
    positions: int = option('Number of positions wanted.', 18, min=1, max=999),
    soak: str = option('Time at rest wanted in each position: 45min, 1.5h, 30s.', '45min'),
    serial: str | None = option(
        'Serial of the unit, written to the bags.', callback=options.check_serial
    ),
    finish: bool = option(
        'First complete the bags that a crashed run has left.', False, '--finish/--no-finish'
    ),
    offset: float | None = options.OFFSET,
    topics: Any = options.reading,
    out: Output = options.out,
) -> None:
    """
    Record a test, a bag per position, and show which data are missing.

    Reads the topics of the driver, or a growing bag. Shows the positions with
    their temperatures and ramps, the expected accuracy of bias, scale and
    misalignment, and the direction for the next position. Ends when the test
    or the bag is complete, or with Ctrl-C; the same command continues the test.

    Example:
      thermo_comp record --positions 18 --soak 45min -o bags/unit43
      thermo_comp record held_out.mcap --positions 1 --soak 1h -o bags/unit44
    """
    from ..recording.growing import PositionBags, growing_blocks, numbered_bags
    from ..ros.process import SignalWatch
    from .acquisition import Acquisition

    test = Acquisition(positions, _duration(soak), offset or 0.0)
    _print_leftovers(out, output, finish)
    earlier = numbered_bags(output)
    serial = _read_earlier(out, earlier, serial, test)
    bags = PositionBags(output, serial)
    stopped = threading.Event()
    problems: Callable[[], Sequence[str]] = tuple
    printed: dict[str, str] = {}
    # A second SIGINT or SIGTERM ends the process at once.
    with SignalWatch() as signals, closing(bags), ExitStack() as stack:
        signals.on_signal(stopped.set)
        if bag is not None:
            news = growing_blocks(bag, topics=topics, wait=stopped.wait)
        else:
            options.require_ros()
            from ..ros.listener import LiveTopics

            live = stack.enter_context(LiveTopics(topics=topics, ros_args=context.obj))
            news, problems = live.blocks(stopped.wait), lambda: live.problems
            out.line('listening; Ctrl-C ends the recording with complete bags')
            sys.stdout.flush()  # a program that reads the pipe waits for 'listening'
        show = stack.enter_context(out.live())
        for account in _accounts(out, news, test, bags):
            if show is None:
                _print_account(out, account, problems(), printed)
            else:
                lines = [*problems(), _now(account), *_lines(account)]
                show(_COLUMNS, _rows(account.positions), lines)
    if bag is None and live.n_lost:
        out.note(f'lost messages of the drivers: {live.n_lost}')
    _end(out, test.account(), output, [*earlier, *bags.written], offset, stopped.is_set())


def _read_earlier(
    out: Output, earlier: Sequence[Path], serial: str | None, test: 'Acquisition'
) -> str | None:
    """Add the bags of earlier runs, one per position, to the test; return the unit's serial."""
    from ..recording.reader import open_recording

    with out.progress('reading the existing bags', total=len(earlier)) as done:
        for number, path in enumerate(earlier, 1):
            with open_recording(path, require=()) as reader:
                bag_serial = reader.info.metadata.get('serial')
                if serial is not None and bag_serial not in (serial, None):
                    raise ThermoCompError(
                        f'{path} is of unit {bag_serial}, not {serial}: record each unit into a '
                        'separate folder'
                    )
                serial = serial or bag_serial
                for block in reader.blocks():
                    test.add(block)
            test.begin()
            done(number)
    return serial


def _accounts(
    out: Output, news: Iterable['News | None'], test: 'Acquisition', bags: 'PositionBags'
) -> Iterator['Account']:
    """Write blocks until test or bag ends; yield the test's state each time `news` gives None."""
    chosen: str | None = None
    for new in news:
        if new is not None:
            block, info = new
            if info is not None and info.chosen != chosen:
                chosen = info.chosen
                out.sources([(info.path, chosen, None)])
            bags.add(block, info)
            for begin_ns in test.add(block):
                bags.close(begin_ns)
            bags.release(test.settled_ns)
            continue
        account = test.account()
        yield account
        if account.is_complete:
            return


def _end(
    out: Output,
    account: 'Account',
    folder: Path,
    written: Sequence[Path],
    offset: float | None,
    is_stopped: bool,
) -> None:
    rested = [position for position in account.positions if position.n_rests]
    out.table(_COLUMNS, _rows(rested))
    for line in _lines(account):
        out.line(line)
    command = f'thermo_comp fit {shlex.quote(str(folder))}/*.mcap -o unit.yaml --gravity G'
    if offset is not None:
        command += f' --offset {offset:g}'
    out.line(f'{counted(len(written), "bag")} in {folder}')
    if written:
        out.line('now fit the bags; replace G by the local gravity in m/s^2:')
        out.line(f'  {command}')
    bias, scale, misalignment = account.constants_sd.reshape(3, 3)
    out.end(
        int(not account.is_complete and not is_stopped),
        bags=written,
        command=command if written else None,
        positions=rested,
        bias_sd_g=bias,
        scale_sd=scale,
        misalignment_sd_rad=misalignment,
        **picked(account, 'n_good is_complete worst_sd_g thermometers next_up findings'),
    )


def _print_leftovers(out: Output, folder: Path, is_finishing: bool) -> None:
    from ..recording import growing

    for path, number in growing.leftovers(folder).items():
        if not is_finishing:
            out.note(f'{path} is bag {number} of a crashed run; --finish completes the bag')
            continue
        try:
            made = growing.finish(path, number)
        except RecordingError as error:
            out.note(f'{error}: the bag cannot be completed')
        else:
            out.note(f'{path.name}: {f"completed as {made}" if made else "contains no messages"}')


def _duration(text: str) -> float:
    """Return the seconds of a duration like ``45min``, ``1.5h`` or ``30s``."""
    match = re.fullmatch(r'\s*(\d+\.?\d*|\.\d+)\s*(h|min|s)\s*', text)
    if match is None or not float(match[1]):
        raise options.usage(f'--soak: expected a duration like 45min, 1.5h or 30s, got {text!r}')
    return float(match[1]) * {'h': 3600.0, 'min': 60.0, 's': 1.0}[match[2]]


def _print_account(
    out: Output, account: 'Account', problems: Sequence[str], printed: dict[str, str]
) -> None:
    """Print each new text about the test; `printed`: the last text printed, by name."""
    news = {'problem': ', '.join(problems)} if problems else {}
    if not problems:
        printed.pop('problem', None)
    for number, position in enumerate(account.positions, 1):
        if position.n_rests:
            news[f'position {number}'] = f'{position.reason or "good"}; {_reading(position.up)}'
    # Noise changes the direction after the semicolon: compare the text before the semicolon.
    new = {name: x for name, x in news.items() if printed.get(name) != x.partition(';')[0]}
    for name, text in new.items():
        printed[name] = text.partition(';')[0]
        out.note(f'{name}: {text}')
    if any(text.startswith('good') for text in new.values()):
        out.note(_accuracy(account))
        out.note(_next(account))


def _reading(up: 'Floats') -> str:
    return ', '.join(f'{axis} {value:+.2f} g' for axis, value in zip('xyz', up, strict=True))


def _rows(positions: Sequence['Position']) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for number, position in enumerate(positions, 1):
        board = position.thermometers.get('board')
        spans: tuple[Cell, ...] = ('', '')
        if board is not None:
            spans = (
                f'{board.lowest:.1f} .. {board.highest:.1f}',
                f'{board.steepest_cooling_k_min:.2f} .. {board.steepest_heating_k_min:.2f}',
            )
        up = [f'{value:+.2f}' for value in position.up] if position.n_rests else [''] * 3
        more = f', {position.n_rests} rests' if position.n_rests > 1 else ''
        still = f'{position.still_s / 60.0:.1f}'
        rows.append((number, *up, still, *spans, (position.reason or 'good') + more))
    return rows


def _now(account: 'Account') -> str:
    if isnan(account.now[0]):
        return 'no samples yet'
    return f'now {"at rest" if account.is_still else "moving"}: {_reading(account.now)}'


def _next(account: 'Account') -> str:
    from ..fitting.coverage import direction_text

    angle = (
        ''
        if isnan(account.next_deg)
        else f', {account.next_deg:.0f} deg from the present direction'
    )
    return f'next position: {direction_text(account.next_up)}{angle}'


def _accuracy(account: 'Account') -> str:
    bias, scale, misalignment = account.constants_sd.reshape(3, 3)
    parts = (
        f'specific force in the worst attitude {ug_text(account.worst_sd_g * STANDARD_GRAVITY)}',
        f'bias of x y z {" ".join(ug_text(value * STANDARD_GRAVITY) for value in bias)}',
        f'scale {" ".join(micro(1e6 * value) for value in scale)} ppm',
        f'misalignment {" ".join(micro(1e6 * value) for value in misalignment)} urad',
    )
    return f'standard deviations: {", ".join(parts)}'


def _lines(account: 'Account') -> list[str]:
    """Return the lines below the table of positions: state of the test, and missing data."""
    from ..fitting.coverage import direction_text

    lines = [_accuracy(account)]
    if account.farthest_deg > 0.0:
        where = direction_text(account.farthest_up)
        lines.append(f'no position within {account.farthest_deg:.0f} deg of {where}')
    for name, survey in account.thermometers.items():
        lines.append(
            f'{name} {survey.lowest:.1f} .. {survey.highest:.1f} degC, ramps '
            f'{survey.steepest_cooling_k_min:+.2f} .. {survey.steepest_heating_k_min:+.2f} K/min'
        )
    if not account.is_complete:
        lines.append(_next(account))
    return [*lines, *(f'- {finding}' for finding in account.findings)]
