# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""A command never replaces an input or a file of another kind, and respects the umask."""

import os
import stat
import threading
from pathlib import Path

import pytest
from builders import calibration
from test_cli_errors import bag

from thermo_comp import files
from thermo_comp.errors import OutputError
from thermo_comp.unit.calibration_file import save_calibration

FILES = (files.CALIBRATION, files.PAGE, files.PARAMETERS, files.PARQUET, files.MCAP,
         files.PICTURE, files.CSV)  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    save_calibration(calibration(), tmp_path / 'unit.yaml')
    bag(tmp_path / 'raw.mcap')
    bag(tmp_path / 'raw')
    for name in ('raw.mcap', 'raw', 'unit.yaml'):
        (tmp_path / f'link_{name}').symlink_to(name)
    (tmp_path / 'hard.mcap').hardlink_to(tmp_path / 'raw.mcap')
    (tmp_path / 'hard.yaml').hardlink_to(tmp_path / 'unit.yaml')
    (tmp_path / 'hard_part.mcap').hardlink_to(tmp_path / 'raw' / 'raw_0.mcap')
    (tmp_path / 'above').mkdir()
    (tmp_path / 'above' / 'in.mcap').hardlink_to(tmp_path / 'raw.mcap')
    (tmp_path / 'above' / 'metadata.yaml').touch()
    return tmp_path


REPLAY = ('replay', '-c', 'unit.yaml', '--serial', 'T-1')
FIT = ('fit', '--gravity', '9.80665')


@pytest.mark.parametrize(
    ('command', 'source', 'output'),
    [
        *((REPLAY, 'raw.mcap', f'{name}.mcap') for name in ('raw', 'above/../raw', 'link_raw')),
        *((REPLAY, 'raw.mcap', name) for name in ('hard.mcap', 'above', '.', 'unit.yaml')),
        *((REPLAY, 'raw', name) for name in ('raw', 'raw/', 'link_raw', 'hard_part.mcap')),
        *((REPLAY, 'raw', f'raw/{name}.mcap') for name in ('raw_0', 'new')),
        (REPLAY, 'link_raw.mcap', 'raw.mcap'),
        (REPLAY, 'above/in.mcap', 'above'),
        (FIT, 'raw.mcap', 'raw.mcap'),
        (FIT, 'raw', 'raw'),
        ((*FIT, '--report', 'link_raw.mcap'), 'raw.mcap', 'new.yaml'),
        ((*FIT, '--report', 'new'), 'raw.mcap', 'new'),
        (('report',), 'raw.mcap', 'hard.mcap'),
        (('report', '-c', 'unit.yaml'), 'raw.mcap', 'hard.yaml'),
        (('export', '--to', 'px4'), 'unit.yaml', 'link_unit.yaml'),
        (('import', '--serial', '42'), 'unit.yaml', 'hard.yaml'),
        (('convert',), 'raw.mcap', 'hard.mcap'),
    ],
    ids=lambda value: ' '.join(value) if isinstance(value, tuple) else value,
)
def test_an_output_is_never_an_input(folder, cli, command, source, output):
    before = {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}
    finished = cli(*command, source, '-o', output, '--force', code=None, cwd=folder)
    assert finished.returncode in (1, 2), finished.stderr
    if output != 'unit.yaml':
        assert 'which the command needs' in finished.stderr
    assert {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()} == before


@pytest.mark.parametrize('kind', FILES, ids=lambda kind: kind.name)
@pytest.mark.parametrize('there', ['work', 'empty', 'folder', 'fifo', 'device'])
def test_an_output_replaces_only_files_of_its_kind(tmp_path, kind, there):
    path = tmp_path / 'output'
    if there == 'fifo':
        os.mkfifo(path)
    elif there == 'folder':
        path.mkdir()
    elif there == 'device':
        path = Path('/dev/null')
    else:
        path.write_bytes(b'years of work' if there == 'work' else b'')
    if there == 'empty':
        files.check_output(path, kind, overwrite=True)
    else:
        with pytest.raises(OutputError, match='is not replaced: it is '):
            files.write_atomically(path, b'new', kind)
        assert Path('/dev/null').is_char_device()
    with pytest.raises(OutputError, match='exists already'):
        files.write_atomically(path, b'new', kind, overwrite=False)


def test_an_output_of_a_command_is_recognised_as_its_kind(folder, cli):
    for command in (
        ('export', 'unit.yaml', '--to', 'px4', '-o', 'a.params'),
        ('export', 'unit.yaml', '--to', 'ardupilot', '-o', 'a.parm'),
        ('report', '-c', 'unit.yaml', '-o', 'page.html', '--figures', 'figures'),
        (*REPLAY, 'raw.mcap', '-o', 'a.mcap'),
        (*REPLAY, 'raw.mcap', '-o', 'a'),
    ):
        cli(*command, cwd=folder)
        assert 'exists already' in cli(*command, code=1, cwd=folder).stderr
        cli(*command, '--force', cwd=folder)


@pytest.mark.parametrize(
    ('kind', 'has_links'), [(files.MCAP, True), (files.MCAP, False), (files.BAG, True)]
)
def test_of_eight_simultaneous_writers_one_writes_the_output(
    tmp_path, kind, has_links, monkeypatch
):
    def refuse(*_):
        raise PermissionError

    if not has_links:  # FAT has no links
        monkeypatch.setattr(os, 'link', refuse)
    start = threading.Barrier(8)
    won = []
    lost = []

    def write(name):
        draft = files.Draft(tmp_path / 'out', kind)
        where = draft.partial / 'metadata.yaml' if kind.is_folder else draft.partial
        where.write_text(name)
        start.wait()
        try:
            draft.publish()
        except OutputError as error:
            lost.append(error.message)
            draft.drop()
        else:
            won.append(name)

    threads = [threading.Thread(target=write, args=(str(n),)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (winner,) = won
    assert lost == ['exists already; --force overwrites it'] * 7
    target = tmp_path / 'out' / 'metadata.yaml' if kind.is_folder else tmp_path / 'out'
    assert target.read_text() == winner
    assert [path.name for path in tmp_path.iterdir()] == ['out']


@pytest.mark.parametrize('mask', [0o022, 0o077])
def test_permissions_of_an_output_follow_the_umask(folder, cli, mask):
    before = os.umask(mask)
    try:
        save_calibration(calibration(), folder / 'private.yaml')
        for output in ('private', 'private.mcap'):
            cli(*REPLAY, 'raw.mcap', '-o', output, code=None, cwd=folder)
    finally:
        os.umask(before)
    for name in ('private.yaml', 'private.mcap', 'private/private_0.mcap'):
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o666 & ~mask, name
    assert stat.S_IMODE((folder / 'private').stat().st_mode) == 0o777 & ~mask
    (folder / 'private.yaml').chmod(0o640)
    save_calibration(calibration(), folder / 'private.yaml')
    assert stat.S_IMODE((folder / 'private.yaml').stat().st_mode) == 0o640


def test_an_output_that_is_a_link_is_written_to_the_target_of_the_link(tmp_path):
    (tmp_path / 'store').mkdir()
    link = tmp_path / 'current.yaml'
    link.symlink_to('store/unit.yaml')
    for overwrite in (False, True):  # the link has no target in the first pass
        save_calibration(calibration(), link, overwrite=overwrite)
        assert link.is_symlink()
        assert not (tmp_path / 'store' / 'unit.yaml').is_symlink()
    (tmp_path / 'round').symlink_to('round')
    with pytest.raises(OutputError):
        save_calibration(calibration(), tmp_path / 'round')


def test_a_writer_that_fails_leaves_no_file(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(OutputError, match=r'unit\.yaml: cannot be written: .*is not a directory'):
        files.write_atomically(tmp_path / 'file' / 'unit.yaml', b'', files.CALIBRATION)
    files.Draft(tmp_path / 'new' / 'bag', files.BAG).drop()
    assert list((tmp_path / 'new').iterdir()) == []


@pytest.mark.parametrize('suffix', ['.db3', '.bag', '.csv', '.MCAP'])
def test_a_bag_with_a_wrong_suffix_is_not_written(folder, cli, suffix):
    output = f'out{suffix}'
    finished = cli('convert', 'raw.mcap', '-o', output, code=1, cwd=folder)
    assert f'{output}: cannot be written: {suffix} is none of' in finished.stderr
    assert not (folder / output).exists()


@pytest.mark.parametrize(('kind', 'name'), [(files.CSV, 'w.parquet'), (files.PAGE, 'unit.pdf')])
def test_the_suffix_states_the_format_of_tables_and_pages(kind, name, tmp_path):
    with pytest.raises(OutputError, match=rf'{name}: cannot be written: .* \*.*, not in \.\w+'):
        files.check_output(tmp_path / name, kind)
    for good in (Path(name).with_suffix(suffix).name for suffix in ('', *kind.suffixes)):
        files.check_output(tmp_path / good, kind)
