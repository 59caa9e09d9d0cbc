# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns the entry point of the command line: its commands and exit codes.

Exit code 0: done; 1: error in data or files, missing package, or invalid result; 2: wrong command
line; 3: `update` does not improve the calibration; 70: a bug of thermo_comp, whose traceback is
saved in a file. The text of an error is printed on one line of stderr.

Heavy libraries are imported by the commands when they run, so that ``--help`` is fast.
"""

import os
import re
import signal
import sys
from typing import Any

import typer
from typer import rich_utils

from .. import __version__
from ..errors import ThermoCompError
from ..text import hold_standard_streams, keep_standard_output
from . import bags, convert, fit, fleet, judge, output, record, simulate
from .shared_options import expanded, option

# Base class of all errors of a command line; typer does not export this class.
_UsageMistake: Any = typer.BadParameter.__mro__[2]

#: Matches typer's message for a value that is not a number; groups: two option names, type.
_NO_NUMBER = re.compile(r"'(-[\w-]+)'(?: / '(-[\w-]+)')?: .*\b(?:a )?valid (number|float|integer)")

# `--help` prints the range of an option's value on its own line, to leave room for the name.
rich_utils.RANGE_STRING = '\n[{}]'

app = typer.Typer(
    name='thermo_comp',
    pretty_exceptions_enable=False,
    context_settings={'help_option_names': ['-h', '--help']},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f'thermo_comp {__version__}')
        raise typer.Exit


@app.callback()
def _top(
    version: bool = option(
        'Print the version.', False, '--version', callback=_print_version, is_eager=True
    ),
) -> None:
    """Thermal-drift compensation of a three-axis accelerometer."""


for _command in (
    *(record.record, fit.fit, fit.prior, judge.evaluate, bags.replay, bags.play, bags.info),
    *(judge.update, judge.report, convert.convert, convert.export, convert.import_),
    simulate.simulate,
):
    app.command(_command.__name__.rstrip('_'))(expanded(_command))
_fleet = typer.Typer(name='fleet', help='Fit many units, and compare them.')
_fleet.command('fit')(expanded(fleet.fleet_fit))
app.add_typer(_fleet)


def main(arguments: list[str] | None = None) -> None:
    """Run one command and end the process with the command's exit code."""
    hold_standard_streams()
    keep_standard_output()
    # On busy cores, operations on small matrices take 16 times longer with several BLAS threads.
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # SIGTERM runs clean-up code
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run the command with these arguments (without the program's name); return the exit code."""
    arguments, ros_arguments = split_arguments(arguments)
    if not arguments:
        app(['--help'], prog_name='thermo_comp', standalone_mode=False)
        return 2
    try:
        code = app(arguments, prog_name='thermo_comp', standalone_mode=False, obj=ros_arguments)
        sys.stdout.flush()
    except _UsageMistake as mistake:
        context = getattr(mistake, 'ctx', None)
        command = 'thermo_comp' if context is None else context.command_path
        if message := mistake.format_message():  # '' if typer has printed the help instead
            output.error(f'{_plain(message, arguments)} (see: {command} --help)')
        return int(mistake.exit_code)
    except typer.Abort:
        return 1
    except ThermoCompError as failure:
        problem = str(failure)
    except ModuleNotFoundError as failure:
        problem = f'this command needs {failure.name}: pip install thermo_comp'
    except BrokenPipeError:
        # The reader has closed the pipe (`... | head`): avoid the interpreter's message at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as failure:
        where = f'{failure.filename}: ' if failure.filename else ''
        problem = f'{where}{failure.strerror or failure}'
    except Exception as failure:  # noqa: BLE001 - any other error is a bug of thermo_comp
        return _unexpected(failure)
    else:
        return code if isinstance(code, int) else 0
    output.error(problem)
    return 1


def _plain(message: str, arguments: list[str]) -> str:
    """Rewrite typer's message on a value that is not a number, and quote the value."""
    message = message.removeprefix('Invalid value: ')  # the rest of the message names the option
    option = _NO_NUMBER.search(message)
    if option is None:
        return message
    given = [
        word.partition('=')[2] or following
        for word, following in zip(arguments, [*arguments[1:], ''], strict=True)
        if word.partition('=')[0] in (option[1], option[2])
    ]
    values = ', '.join(map(repr, given))
    wanted = 'a whole number' if option[3] == 'integer' else 'a number with a point, like 9.8154'
    return f'{option[1]}: expected {wanted}, got {values}'


def split_arguments(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Return the command's arguments, and ROS arguments (from ``--ros-args`` up to ``--``)."""
    for_command: list[str] = []
    for_ros: list[str] = []
    target = for_command
    for argument in arguments:
        if argument == '--ros-args':
            target = for_ros
        elif argument == '--' and target is for_ros:
            target = for_command
        else:
            target.append(argument)
    return for_command, for_ros


def _unexpected(failure: Exception) -> int:
    """Save the traceback of an unexpected error, print the file's name, return the exit code."""
    import tempfile
    import traceback

    lines = [f'thermo_comp {__version__}, {sys.version}\n', *traceback.format_exception(failure)]
    try:
        descriptor, name = tempfile.mkstemp(prefix='thermo_comp-', suffix='.log')
        with os.fdopen(descriptor, 'w', encoding='utf-8', errors='backslashreplace') as log:
            log.writelines(lines)
        where = f'in {name}'
    except OSError as error:
        where = f'not written ({error.strerror})'
    reason = f'{type(failure).__name__}: {failure}'
    output.error(
        f'unexpected {reason:.300}; this is a bug of thermo_comp, its traceback is {where}'
    )
    return 70  # EX_SOFTWARE of sysexits.h
