# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of any layout give equal columns; messages name the place of a wrong cell."""

import numpy as np
import pytest

from thermo_comp.convert.column_map import ColumnMap, table_log
from thermo_comp.convert.log import NO_STAMP, write_log
from thermo_comp.convert.table import Format, Stamp, exact_ns, read_parquet, read_text
from thermo_comp.errors import RecordingError
from thermo_comp.recording.reader import read_recording
from thermo_comp.recording.topics import Topics
from thermo_comp.unit.schema import build

ROWS_ALONE = Stamp(rate_hz=1.0)
ROWS = [(1000, 0.5, -1.25), (1001, 0.25, 2e-3), (1003, -7.0, 1.5)]


def write(path, text):
    path.write_bytes(text.encode())
    return path


@pytest.mark.parametrize(
    ('delimiter', 'newline', 'prefix'),
    [
        (',', '\n', ''),
        (';', '\r\n', ''),
        ('\t', '\n', '\ufeff'),
        ('|', '\n', '# a logger wrote this\n'),
        ('  ', '\n', '\n'),
    ],
    ids=['comma', 'semicolon-crlf', 'tab-bom', 'bar-comment', 'blanks'],
)
def test_every_layout_of_a_table_gives_equal_values(tmp_path, delimiter, newline, prefix):
    lines = [delimiter.join(('t', 'a', 'b'))]
    lines += [delimiter.join(map(str, row)) for row in ROWS]
    path = write(tmp_path / 'log.txt', prefix + newline.join(lines) + newline)
    table = read_text(path, ['b', 'a'], Stamp('t', 'ms'))
    assert table.stamp_ns.tolist() == [1000 * 10**6, 1001 * 10**6, 1003 * 10**6]
    assert table.values['a'].tolist() == [row[1] for row in ROWS]
    assert table.values['b'].tolist() == [row[2] for row in ROWS]
    assert table.n_short == 0


def test_headings_of_a_table_are_optional(tmp_path):
    path = write(tmp_path / 'log.txt', '1 2 3\n4 5 6\n')
    assert read_text(path, [2], ROWS_ALONE).values[2].tolist() == [3.0, 6.0]
    # 'nan' and 'inf' are numbers, unless the user states that the first line is a heading.
    path = write(tmp_path / 'words.txt', 'nan inf\n1 2\n')
    assert read_text(path, [0], ROWS_ALONE, Format(header=True)).values[0].tolist() == [1.0]


@pytest.mark.parametrize('separator', [',', ';', '\t', ' '])
def test_lines_before_the_table_of_a_logger_are_left_out(tmp_path, separator):
    # The row of units becomes a row of NaN; the incomplete last row is counted and left out.
    head = ['Inertial logger', '# serial 7', '% matlab', '// c', f'Rate:{separator}100', '']
    rows = ['t|ax|ay|az', 's|g|g|g', *(f'{k}|0.1|0.2|{k}' for k in range(60)), '# end', '60|0.1']
    text = '\n'.join([*head, *(row.replace('|', separator) for row in rows)])
    table = read_text(write(tmp_path / 'log.csv', text), ['t', 'az'], ROWS_ALONE)
    assert np.isnan(table.values['t'][0])
    np.testing.assert_array_equal(table.values['az'][1:], np.arange(60.0))
    assert table.line[1] == 9
    assert table.n_short == 1


def test_a_column_of_a_table_may_begin_late(tmp_path):
    # WHY: a table was refused if the last column, a thermometer, is blank in the first rows.
    rows = [f'{k},0.1,{"" if k < 20 else 20 + k}' for k in range(60)]
    path = write(tmp_path / 'log.csv', '\n'.join(['t,ax,celsius', *rows]))
    table = read_text(path, ['t', 'celsius'], ROWS_ALONE)
    np.testing.assert_array_equal(table.values['t'], np.arange(60.0))
    assert np.isnan(table.values['celsius'][:20]).all()
    assert table.values['celsius'][20] == 40.0


def test_line_numbers_are_those_of_an_editor(tmp_path):
    path = write(tmp_path / 'log.csv', '# made by hand\na,b\n\n1,2\nx,3\n4\n5,6\n')
    table = read_text(path, ['a', 'b'], ROWS_ALONE)
    assert table.line.tolist() == [4, 5, 7]
    np.testing.assert_array_equal(table.values['a'], [1.0, np.nan, 5.0])
    # The row with a single cell is counted and left out.
    assert table.n_short == 1


def test_stamps_of_a_table_are_exact():
    # Numbers of double precision would round nanoseconds since 1970 to steps of 256 ns.
    cells = ['1767225600.123456789', '1767225600123456789e-9', ' +2 ', '1.5e-9']
    exact = [1767225600123456789, 1767225600123456789, 2 * 10**9, 2]
    assert [exact_ns(cell, 's') for cell in cells] == exact
    assert exact_ns('1767225600123456789', 'ns') == 1767225600123456789
    bad = ['', 'soon', 'nan', 'inf', '1e40', '99999999999999999999']
    assert {exact_ns(cell, 'ns') for cell in bad} == {NO_STAMP}


@pytest.mark.parametrize(
    ('text', 'column', 'message'),
    [
        ('', 'a', 'the table is empty'),
        (' \n\n', 'a', 'the table is empty'),
        ('# only a comment\n', 'a', 'the table is empty'),
        ('a,b\n', 'a', 'headings but no rows'),
        ('a,b\n1,2\n', 'c', "no column 'c'; there are: 'a', 'b'"),
        ('a,a\n1,2\n', 'a', "2 columns are called 'a'"),
        ('1,2\n3,4\n', 'a', "no column 'a': the table has no headings"),
        ('1,2\n3,4\n', 2, 'no column 2: the table has 2 columns, 0 to 1'),
        ('1,2\n3,4\n', -1, 'no column -1: the table has 2 columns, 0 to 1'),
        # WHY: of a table with decimal commas only rows with whole numbers were read.
        ('a;b\n1,5;2\n3;4\n5;6\n', 'a', "column 'a' has decimal commas, it begins with 1,5"),
        ('a,b\n\0\0\n', 'a', 'it holds zero bytes'),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, column, message):
    path = write(tmp_path / 'log.csv', text)
    with pytest.raises(RecordingError, match=message) as caught:
        read_text(path, [column], ROWS_ALONE)
    assert str(path) in str(caught.value)


def test_a_missing_table_is_refused(tmp_path):
    with pytest.raises(RecordingError, match='No such file'):
        read_text(tmp_path / 'absent.csv', ['a'], ROWS_ALONE)


class TestParquet:
    @pytest.fixture(autouse=True)
    def needs_pyarrow(self):
        pytest.importorskip('pyarrow', reason='pyarrow is the extra `parquet`')

    def table(self, tmp_path, **columns):
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table(columns), tmp_path / 'log.parquet')
        return tmp_path / 'log.parquet'

    def test_a_parquet_table_gives_the_values_of_the_text_table(self, tmp_path):
        path = self.table(
            tmp_path, t=[row[0] for row in ROWS], a=[row[1] for row in ROWS], b=[1, None, 3]
        )
        table = read_parquet(path, ['a', 'b'], Stamp('t', 'ms'))
        assert table.stamp_ns.tolist() == [1000 * 10**6, 1001 * 10**6, 1003 * 10**6]
        assert table.values['a'].tolist() == [row[1] for row in ROWS]
        np.testing.assert_array_equal(table.values['b'], [1.0, np.nan, 3.0])

    def test_parquet_timestamps_have_their_unit(self, tmp_path):
        path = self.table(
            tmp_path, t=np.array([1767225600123, 0], dtype='datetime64[ms]'), a=[1.0, 2.0]
        )
        table = read_parquet(path, ['a'], Stamp('t', 's'))
        assert table.stamp_ns.tolist() == [1767225600123 * 10**6, 0]

    def test_parquet_stamps_may_be_fractional_seconds(self, tmp_path):
        path = self.table(tmp_path, t=[0.5, float('nan')], a=[1.0, 2.0])
        table = read_parquet(path, ['a'], Stamp('t', 's'))
        assert table.stamp_ns.tolist() == [500_000_000, NO_STAMP]

    def test_unreadable_parquet_is_refused(self, tmp_path):
        path = self.table(tmp_path, a=['one', 'two'])
        with pytest.raises(RecordingError, match="column 'a' holds string"):
            read_parquet(path, ['a'], ROWS_ALONE)
        with pytest.raises(RecordingError, match="no column 'b'"):
            read_parquet(path, ['b'], ROWS_ALONE)
        with pytest.raises(RecordingError, match='the table is empty'):
            read_parquet(self.table(tmp_path, a=np.array([], dtype=float)), ['a'], ROWS_ALONE)
        path.write_text('a,b\n')
        with pytest.raises(RecordingError, match='not a readable Parquet file'):
            read_parquet(path, ['a'], ROWS_ALONE)


@pytest.mark.parametrize('suffix', ['csv', 'parquet'])
@pytest.mark.parametrize('unit', ['s', 'ns'])
def test_stamps_that_ros_cannot_hold_are_left_out(tmp_path, suffix, unit):
    """A row with a stamp outside 0 to 2^31 s is left out and counted, also 2e10 s."""
    scale = 10**9 if unit == 's' else 1
    good = [10**9 + k for k in range(40)] if unit == 's' else [10**18 + k for k in range(40)]
    bad = [-1, 2**31, 2 * 10**10, 2**62, 2**63] if unit == 's' else [-1, 2**31 * 10**9, 2**63]
    rows = good + bad

    def written(stamps):
        path = tmp_path / f'log.{suffix}'
        if suffix == 'csv':
            path.write_text('\n'.join(['t,x,y,z', *(f'{at},5.66,5.66,5.66' for at in stamps)]))
            return path
        pytest.importorskip('pyarrow', reason='pyarrow is the extra `parquet`')
        import pyarrow as pa
        import pyarrow.parquet as pq

        kind = pa.int64() if min(stamps) < 0 else pa.uint64()
        stored = [min(stamp, 2**62) if min(stamps) < 0 else stamp for stamp in stamps]
        columns = {'t': pa.array(stored, kind), **dict.fromkeys('xyz', [5.66] * len(stamps))}
        pq.write_table(pa.table(columns), path)
        return path

    accel = {'columns': ['x', 'y', 'z'], 'unit': 'm/s^2', 'output': 'imu'}
    chart = build(ColumnMap, {'stamp': {'column': 't', 'unit': unit}, 'accel': accel})
    for stamps in (rows, good + bad[1:]):
        report = write_log(table_log(written(stamps), chart), tmp_path / 'bag.mcap', force=True)
        left_out = report.findings['out_of_range'].count + report.findings['non_numeric'].count
        assert (report.messages['accel'], left_out) == (40, len(stamps) - 40)
        bag = read_recording(tmp_path / 'bag.mcap', Topics(input='imu'), require=('accel',))
        accel_stamp_ns = bag.columns.accel_stamp_ns
        assert accel_stamp_ns.tolist() == [stamp * scale for stamp in good]
    with pytest.raises(RecordingError, match=r'before 1970 or after January 2038|holds numbers'):
        write_log(table_log(written(bad[1:]), chart), tmp_path / 'none.mcap')
