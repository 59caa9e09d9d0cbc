# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The compiled core is the interpreted one: built as a user builds it, run, compared to the bit.

"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from build_helpers import ROOT, missing, run

from thermo_comp.online import kernel
from thermo_comp.online.kernel import Lines
from thermo_comp.online.status import DROPPED
from thermo_comp.typing import Floats, Stamps

HERE = Path(__file__).resolve().parent


@pytest.fixture(scope='module')
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the compiled core beside a copy of the package."""
    if missing():
        pytest.skip(missing())
    path = tmp_path_factory.mktemp('compiled')
    shutil.copytree(
        ROOT / 'thermo_comp',
        path / 'thermo_comp',
        ignore=shutil.ignore_patterns('__pycache__', '*.so'),
    )
    for name in ('setup.py', 'README.md'):
        shutil.copy(ROOT / name, path / name)
    finished = run('setup.py', '-q', 'build_ext', '-i', cwd=str(path), THERMO_COMP_COMPILE='1')
    assert finished.returncode == 0, finished.stdout + finished.stderr
    # What the compiler makes of the modules on its way is not left beside the source.
    assert not [*path.glob('.mypy_cache'), *path.rglob('__native*.c')]
    return path


def saved(path: Path, core: Path) -> dict[str, np.ndarray]:
    finished = run(
        HERE / 'compiled_run.py', path, PYTHONPATH=os.pathsep.join([str(core), str(HERE)])
    )
    assert finished.returncode == 0, finished.stderr
    with np.load(path) as arrays:
        return dict(arrays)


def test_both_cores_give_the_same_bits(tree: Path, tmp_path: Path) -> None:
    """
    WHY: a flight replayed on another machine must give the bits that the vehicle published.

    WHAT: a simulated day with lost, frozen, jumping and quantized thermometers, bad samples, a
    loop of time, a reload, in the stream and in blocks: every number, status and flag.

    """
    interpreted = saved(tmp_path / 'interpreted.npz', ROOT)
    compiled = saved(tmp_path / 'compiled.npz', tree)
    assert not interpreted.pop('is_compiled').any()
    assert compiled.pop('is_compiled').all()
    assert interpreted.keys() == compiled.keys()
    for name, values in interpreted.items():
        np.testing.assert_array_equal(compiled[name], values, err_msg=name)
    # The comparison means something only if everything happened.
    for kind in ('smooth', 'cells', 'degrees'):
        last, flags = interpreted[f'{kind}_batch_texts'][-2:]
        assert 'True' in flags
        assert 'False' in flags
        for counter in (*DROPPED, 'n_board_rejected', 'n_case_rejected', 'n_time_jumps'):
            assert int(re.search(rf'{counter}=(\d+)', last)[1]), (kind, counter)


@pytest.fixture(scope='module')
def correct_in_c(tree: Path) -> Callable[..., object]:
    """Load the C form of the samples' arithmetic; the rest of this process is interpreted."""
    (file,) = (tree / 'thermo_comp').glob('_kernel*.so')
    spec = importlib.util.spec_from_file_location('thermo_comp._kernel', file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.correct


def problem(counts: list[int], **odd: float) -> tuple[Lines, tuple[float, ...], Stamps, Floats]:
    """Make segments of so many samples, which lie in packed records as a reader has them."""
    rng = np.random.default_rng(7)
    n = sum(counts)
    # Between the fields a byte, so that nothing is aligned.
    records = np.zeros(n, [('stamp_ns', '<i8'), ('pad', 'u1'), ('sample', '<f8', 3)])
    records['stamp_ns'] = 1_767_225_600_000_000_000 + np.cumsum(rng.integers(1, 5_000_000, n))
    records['sample'] = rng.normal(size=(n, 3)) * 10.0 ** rng.integers(-3, 6, (n, 3))
    ends = np.cumsum(counts, dtype=np.int64)
    first = np.minimum(ends - counts, max(n - 1, 0))
    start_ns = records['stamp_ns'][first] - 123_456_789 if n else np.zeros(len(counts), np.int64)
    columns = [rng.normal(size=len(counts)) for _ in range(21)]
    if 'scale' in odd:
        columns[2][:], columns[3][:] = odd['scale'], 0.0
    for k, (name, value) in enumerate(odd.items()):
        if name != 'scale':
            records['sample'][k::5, k % 3] = value
    lines = Lines(start_ns, columns, np.array(counts, dtype=np.int64))
    return lines, tuple(rng.normal(size=6) * 0.01), records['stamp_ns'], records['sample']


def bits(values: Floats) -> np.ndarray:
    """Give the bits; of NaN, whose sign and payload no arithmetic promises, that it is one."""
    return np.where(np.isnan(values), np.uint64(1), np.ascontiguousarray(values).view(np.uint64))


@pytest.mark.parametrize(
    ('counts', 'odd'),
    [
        ([400] * 40, {}),
        # Pieces of numpy's way and of C's are cut elsewhere.
        ([1] * 50 + [255, 256, 257, 0, 511, 513, 3, 25_000], {}),
        ([1], {}),
        ([0, 0, 5, 0], {}),
        ([], {}),
        ([700, 2], {'nan': np.nan, 'inf': np.inf, 'saturated': -(2.0**23)}),
        ([700, 2], {'low': -np.inf, 'negative zero': -0.0, 'tiny': 5e-324, 'huge': 1.7e308}),
        ([700, 2], {'scale': 0.0, 'nothing': 0.0}),
    ],
)
def test_samples_have_the_same_bits_in_c(
    correct_in_c: Callable[..., object],
    monkeypatch: pytest.MonkeyPatch,
    counts: list[int],
    odd: dict[str, float],
) -> None:
    arguments = problem(counts, **odd)
    with np.errstate(all='ignore'):
        wanted = kernel.correct(*arguments)
    monkeypatch.setattr(kernel, '_correct_in_c', correct_in_c)
    # Whatever is not finite is no reason to warn.
    with np.errstate(all='raise'):
        got = kernel.correct(*arguments)
    for name, mine, theirs in zip(('force', 'covariance'), got, wanted, strict=False):
        assert mine.shape == theirs.shape
        np.testing.assert_array_equal(bits(mine), bits(theirs), err_msg=name)
    np.testing.assert_array_equal(got[2:], wanted[2:])


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_one_nan_is_both_extremes_in_c(correct_in_c: Callable[..., object], axis: int) -> None:
    lines, misalignment, stamps, samples = problem([300, 300])
    for row in (0, 258, 299, 300, 599):
        for beside in (0.0, np.inf):
            column = np.array(samples)
            column[max(row - 1, 0), axis] = beside
            column[row, axis] = np.nan
            out = np.empty((12, 600))
            low, high = correct_in_c(*lines.tables(), stamps, column, out, misalignment)
            wanted = np.arange(3) == axis
            np.testing.assert_array_equal(np.isnan([low, high]), [wanted, wanted])


ARGUMENTS = ('start_ns', 'counts', 'columns', 'stamps', 'samples', 'out', 'misalignment')


@pytest.mark.parametrize(
    ('name', 'change', 'error', 'said'),
    [
        ('start_ns', lambda a: a[:1], ValueError, 'counts'),
        ('start_ns', lambda a: a.astype(float), TypeError, 'start_ns must hold integers'),
        ('counts', lambda a: a.astype(np.int32), TypeError, 'counts must hold integers'),
        ('counts', lambda a: np.add(a, [0, 1]), ValueError, 'sum up'),
        ('counts', lambda a: np.subtract(a, [0, 1]), ValueError, 'sum up'),
        ('counts', lambda a: np.add(a, [-6, 6]), ValueError, 'negative'),
        ('counts', lambda a: np.add(a, [1 << 62, 1 << 62]), ValueError, 'sum up'),
        ('columns', lambda a: a[:20], ValueError, 'columns'),
        ('columns', lambda a: a[:, :1], ValueError, 'columns'),
        ('columns', lambda a: a[0], ValueError, '2 dimension'),
        ('stamps', lambda a: a[:-1], ValueError, 'samples'),
        ('stamps', lambda a: a.view(np.uint64), TypeError, 'stamps must hold integers'),
        ('stamps', lambda a: a.tolist(), TypeError, 'bytes-like'),
        ('samples', lambda a: a[:-1], ValueError, 'samples'),
        ('samples', lambda a: a[:, :2], ValueError, 'samples'),
        ('samples', lambda a: a.astype('f4'), TypeError, 'samples must hold floats'),
        ('samples', lambda a: a.astype('>f8'), TypeError, 'samples must hold floats'),
        ('samples', lambda a: a.astype('c8'), TypeError, 'samples must hold floats'),
        ('samples', lambda a: a.tobytes(), TypeError, 'samples must hold floats'),
        ('out', lambda a: a[:11], ValueError, 'out'),
        ('out', lambda a: a[:, :-1].copy(), ValueError, 'out'),
        ('out', lambda a: np.empty(a.T.shape).T, ValueError, 'contiguous'),
        ('out', lambda a: np.broadcast_to(0.0, a.shape), ValueError, 'contiguous|read-only'),
        ('out', lambda a: a.view(np.int64), TypeError, 'out must hold floats'),
        ('misalignment', lambda a: a[:5], TypeError, '6'),
        ('misalignment', lambda a: ('a', *a[1:]), TypeError, 'real number'),
    ],
)
def test_c_refuses_what_does_not_fit(
    correct_in_c: Callable[..., object],
    name: str,
    change: Callable[[Any], object],
    error: type[Exception],
    said: str,
) -> None:
    lines, misalignment, stamps, samples = problem([5, 3])
    given = (*lines.tables(), stamps, samples, np.empty((12, 8)), misalignment)
    correct_in_c(*given)
    wrong = dict(zip(ARGUMENTS, given, strict=True))
    wrong[name] = change(wrong[name])
    with pytest.raises(error, match=said):
        correct_in_c(*wrong.values())


def test_the_compiled_node_does_what_the_interpreted_does(tree: Path) -> None:
    """
    WHY: the compiler's Python is not quite Python; it could not take a slice from a variable.

    WHAT: the node's own tests over DDS, of its layouts and of its loop, on the compiled way.

    """
    pytest.importorskip('rclpy', reason='rclpy is not installed: the extra `ros`')
    for name in ('conversions', 'relay', 'waitloop'):
        assert list((tree / 'thermo_comp' / 'ros').glob(f'{name}.*.so')), name
    for folder in ('test', 'config'):
        shutil.copytree(ROOT / folder, tree / folder)
    tests = [f'test/test_{name}.py' for name in ('cdr', 'waitloop', 'node', 'node_parity')]
    finished = run('-m', 'pytest', '-q', *tests, cwd=str(tree), PYTHONPATH=str(tree))
    assert finished.returncode == 0, finished.stdout + finished.stderr


def test_a_compiled_core_says_so(tree: Path) -> None:
    finished = run('-m', 'thermo_comp', '--version', cwd=str(tree))
    assert re.fullmatch(r'thermo_comp \S+ \(compiled core\)\n', finished.stdout)
