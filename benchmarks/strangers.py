# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Compares fits of the package with curves fitted by scipy, by their errors on units whose physics
the package does not model.

Run ``python benchmarks/strangers.py`` for every case (many hours), or some cases with fewer units:
``python benchmarks/strangers.py --cases kink,soaks --units 2 --json strangers.json``. A colon
selects one study of a case: ``--cases 'turn-on:9 at 30 ug'``.

Units and recordings come from `strangers_units.py` and `strangers_cases.py`, which share no code
with the package; the package is used only through `thermo_comp.fit` and `Calibration.correct`.
Errors are evaluated on held-out recordings, unless the row states otherwise. An error is the RMS
of means over 60 s in ug: of the norm, ``|f| - g``, and of the vector less the true force. A ratio
is the RMS of error / claimed sd. The table has the RMS of each figure over the units. MISS marks a
limit of `strangers_limits.py` that a row violates; the exit code is then 1. The baselines fitted
by the package take most of the time; ``--baselines strangers.json`` reads the scores of the
baselines from an earlier run.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from strangers_baselines import WINDOW_S, Minutes, by_drift, by_norm, means, minutes, slots
from strangers_cases import CASES, Study
from strangers_limits import Result, Row, Score, misses, rms, rows_of
from strangers_recorded import cats, samples
from strangers_units import GRAVITY, REFERENCE_C, UG, Bag, Floats, rng_of

import thermo_comp
from thermo_comp import CompensatorConfig
from thermo_comp.fitting import FitOptions
from thermo_comp.unit.calibration import parameter_layout
from thermo_comp.unit.posterior import Posterior

#: Fit options of the evaluated model, 'fit', and of the two baselines that the package fits.
PACKAGE: dict[str, dict[str, Any]] = {
    'fit': {},
    'golovach': {'model': 'golovach'},
    'sets': {'groups': ('curve', 'set')},
}
BASELINES = ('constants', 'cubic', 'golovach', 'sets')
#: Least share of the minutes that a fit must correct completely; below 1, because samples before
#: the first reading of a thermometer are not corrected.
LEAST_PUBLISHED = 0.98
#: Cases of recorded bags, each with a single unit.
RECORDED = ('sample-bags', 'no-case', 'board-twice', 'cats')


@dataclass(frozen=True)
class Corrected:
    """
    Means over 60 s of a bag's corrected samples.

    Parameters
    ----------
    force : ndarray, shape (w, 3)
        Specific force [m/s^2].
    claim : ndarray, shape (w, 3, 3)
        Published covariance of the means [m^2/s^4].
    white : ndarray, shape (3,)
        Variance of the mean by white noise, which is independent between means [m^2/s^4].

    """

    force: Floats
    claim: Floats
    white: Floats


def fitted(
    study: Study, prior: thermo_comp.Calibration | None = None, **model: Any
) -> thermo_comp.Calibration:
    """Fit the bags of a study with its options and the options `model`."""
    # Leave out the option `gravity_sd` for versions of the package without this option.
    known = {option.name for option in fields(FitOptions)}
    options = {name: value for name, value in study.options.items() if name in known}
    if prior is not None:
        options['prior'] = prior
    columns = [
        thermo_comp.Columns(bag.time_s, bag.samples, dict(bag.temperatures), name=bag.name)
        for bag in study.bags
    ]
    return thermo_comp.fit(columns, gravity=study.gravity, **options, **model)


def chosen_by(calibration: thermo_comp.Calibration) -> str:
    """List a calibration's groups of columns; response groups with their number of columns."""
    columns = Counter(term.group for term in calibration.response)
    others = {entry.group for entry in calibration.evidence} - set(columns)
    return ' '.join([*sorted(others), *(f'{group}:{n}' for group, n in columns.items())])


def corrected(
    calibration: thermo_comp.Calibration, bag: Bag, config: CompensatorConfig | None = None
) -> Corrected:
    """Correct a bag, and average the corrected forces over each minute."""
    known = ('board', *calibration.sensors)
    given = {key: value for key, value in bag.temperatures.items() if key in known}
    out = calibration.correct(bag.time_s, bag.samples, config=config, **given)
    first, size = slots(bag)
    force, claim = means(out.specific_force, first, size), means(out.covariance, first, size)
    # The published covariance is that of one sample. A mean over a minute reduces white noise and
    # rounding errors of the converter; the other errors are equal in all samples of a minute.
    density = np.square(calibration.noise_density_m_s2_sqrt_hz)
    scale = np.array([axis.scale_factor for axis in calibration.axes])
    rounding = 1.0 / 6.0 if calibration.unit.input == 'counts' else 0.0
    sample = density / calibration.unit.cycle_time_s + rounding / scale**2
    M = np.array(calibration.misalignment)
    common = claim - (M * sample) @ M.T
    diagonal = range(3)
    common[:, diagonal, diagonal] = np.maximum(common[:, diagonal, diagonal], 0.0)
    white = (M * density / WINDOW_S) @ M.T
    return Corrected(force, common + white, np.diag(white))


def score(outs: Sequence[Corrected], bags: Sequence[Minutes], *, is_drift: bool) -> Score:
    """Compare corrected means over a minute with the true force and with their claimed sd."""
    published = [np.isfinite(out.force).all(axis=1) for out in outs]
    if np.mean(np.concatenate(published)) < LEAST_PUBLISHED:
        return Score(np.inf, np.inf, np.inf, np.inf, np.inf)
    outs = [
        replace(out, force=out.force[rows], claim=out.claim[rows])
        for out, rows in zip(outs, published, strict=True)
    ]
    bags = [
        replace(bag, samples=bag.samples[rows], board=bag.board[rows], force=bag.force[rows])
        for bag, rows in zip(bags, published, strict=True)
    ]
    forces = [out.force for out in outs]
    plain = error_of(forces, bags, is_drift=is_drift)
    if is_drift:
        # A mounting's bias offset cancels in the drift. Therefore subtract the smallest claimed
        # variance, which is at the reference temperature, from all claimed variances of a bag.
        variances = [np.diagonal(out.claim, axis1=1, axis2=2) for out in outs]
        sd = np.sqrt(np.concatenate(
            [v - v.min(axis=0) + out.white for v, out in zip(variances, outs, strict=True)]
        ))  # fmt: skip
        return Score(np.nan, plain.vector, np.nan, rms(_drift(forces, bags) / sd), rms(sd) / UG)
    force, claim = np.concatenate(forces), np.concatenate([out.claim for out in outs])
    size = np.linalg.norm(force, axis=1, keepdims=True)
    along = np.sqrt(np.einsum('wi,wij,wj->w', force / size, claim, force / size))
    sd = np.sqrt(np.diagonal(claim, axis1=1, axis2=2))
    vector = force - np.concatenate([bag.force for bag in bags])
    return Score(
        plain.norm,
        plain.vector,
        rms((size[:, 0] - GRAVITY) / along),
        rms(vector / sd),
        rms(np.linalg.norm(sd, axis=1)) / UG,
    )


def error_of(forces: Sequence[Floats], bags: Sequence[Minutes], *, is_drift: bool) -> Score:
    """Compare forces, for which no sd is claimed, with the true forces."""
    if is_drift:
        return Score(vector=rms(_drift(forces, bags)) / UG)
    force, truth = np.concatenate(forces), np.concatenate([bag.force for bag in bags])
    norm = np.linalg.norm(force, axis=1) - GRAVITY
    return Score(rms(norm) / UG, rms(np.linalg.norm(force - truth, axis=1)) / UG)


def _drift(forces: Sequence[Floats], bags: Sequence[Minutes]) -> Floats:
    """Return the error of each axis less the mean of this error over the bag, shape (w, 3)."""
    errors = [force - bag.force for force, bag in zip(forces, bags, strict=True)]
    return np.concatenate([error - error.mean(axis=0) for error in errors])


def scipy_baselines(study: Study) -> dict[str, Callable[[Minutes], Floats]]:
    """Return the two corrections that scipy fits: constants alone, and with a cubic per axis."""
    bags = [minutes(bag) for bag in study.baseline_bags or study.bags]
    orders = {'constants': 0, 'cubic': 3}
    if study.is_drift:
        # One pose does not determine the scale factors: all are set to |mean sample| / gravity.
        scale = rms(np.linalg.norm(bags[0].samples, axis=1)) / GRAVITY
        return {name: by_drift(bags, scale, order=order) for name, order in orders.items()}
    return {name: by_norm(bags, study.gravity, order=order) for name, order in orders.items()}


def bias_score(calibration: thermo_comp.Calibration, study: Study) -> Score:
    """Return the bias error: correct simulated samples at the reference temperature and f = 0."""
    assert study.bound is not None
    unit, cycle_s = study.bound.unit, calibration.unit.cycle_time_s
    time_s = cycle_s * np.arange(1.0, 3600.0 / cycle_s)
    zero = np.broadcast_to(unit.counts * study.bound.bias, (len(time_s), 3))
    # Readings have noise, because the correction rejects a thermometer with constant readings.
    rng, read_s = rng_of('rest'), np.arange(0.0, 3600.0, 5.0)
    rest = {'board': REFERENCE_C, 'case': REFERENCE_C - unit.heat_k}
    temperatures = {
        key: (read_s, celsius + unit.reading_sd * rng.standard_normal(len(read_s)))
        for key, celsius in rest.items()
    }
    # Switch off two checks of the node, because the samples are constant and |f| is 0.
    config = CompensatorConfig(stuck_timeout_s=0.0, gravity_tolerance_m_s2=0.0)
    bag = Bag('zero', time_s, zero, temperatures)
    out = corrected(calibration, bag, config)
    error = out.force[len(out.force) // 2 :].mean(axis=0)
    # The Cramer-Rao bound does not include thermometer noise and turn-ons: subtract the variance
    # that a calibration without a posterior claims, which contains only these two.
    exact = corrected(replace(calibration, posterior=None), bag, config)
    sd = np.sqrt(np.maximum(np.diag(out.claim[-1] - exact.claim[-1]), 0.0))
    return Score(
        vector=float(np.linalg.norm(error)) / UG,
        ratio=rms(error / sd),
        claim=float(np.linalg.norm(sd)) / UG,
        bound_ratio=rms(error / study.bound.sd),
    )


def without_constants(calibration: thermo_comp.Calibration) -> thermo_comp.Calibration:
    """
    Return a calibration in whose posterior bias, scale and misalignment have no variance.

    A single pose determines bias and scale to 50 mg only. The drift in a pose does not depend on
    bias and scale, but the claimed variance contains ``a^2`` times the variance of the scale
    factor, and so changes with the noise of the acceleration `a`.
    """
    if calibration.posterior is None:
        return calibration
    layout, posterior = parameter_layout(calibration), calibration.posterior
    matrix, variances = posterior.matrix.copy(), posterior.variances.copy()
    blocks = (*layout.bias, *layout.scale)
    constants = [place for block in blocks for place in (block.static, block.dynamic)]
    constants += range(layout.misalignment, layout.n_parameters)
    matrix[constants], variances[constants] = 0.0, 0.0
    return replace(calibration, posterior=Posterior.of(matrix, variances))


def scored(
    study: Study, model: thermo_comp.Calibration, tests: dict[str, list[Minutes]]
) -> dict[str, Score]:
    """Return the scores (errors and ratios) of a calibration for each set of held-out bags."""
    if study.bound is not None:
        return {'': bias_score(model, study)}
    if study.is_drift:
        model = without_constants(model)
    return {
        test: score([corrected(model, bag) for bag in study.tests[test]], bags,
                    is_drift=study.is_drift)
        for test, bags in tests.items()
    }  # fmt: skip


def run(
    case: str,
    unit: int,
    study: Study,
    done: dict[str, thermo_comp.Calibration],
    earlier: Mapping[tuple[str, int], Mapping[str, Score]],
) -> list[Result]:
    """
    Fit all models to a study's bags, and compute their errors on held-out bags.

    Parameters
    ----------
    case, unit, study : str, int, Study
        The fitted study.
    done : dict of str to Calibration
        Fits of this unit by study, for studies with a prior; the new fit is added.
    earlier : mapping of (str, int) to mapping of str to Score
        Scores of baselines from an earlier run, by title and unit; missing scores are computed.

    Returns
    -------
    list of Result
        One result for each set of held-out bags.

    """
    title = f'{case} {study.label}'.strip()
    tests = {test: [minutes(bag) for bag in bags] for test, bags in study.tests.items()}
    titles = {test: title + (f': {test}' if test else '') for test in tests or ('',)}
    known = {test: earlier.get((titles[test], unit), {}) for test in titles}
    scores: dict[str, dict[str, Score]] = {test: {} for test in titles}
    has_baselines = not (study.prior_of or study.bound)
    prior = done[study.prior_of] if study.prior_of else None
    chosen, refused, fit_s = '', '', np.nan
    for model, options in PACKAGE.items():
        if model != 'fit' and (not has_baselines or all(known.values())):
            continue
        began = time.process_time()
        try:
            calibration = fitted(study, prior, **options)
        except (thermo_comp.ThermoCompError, ValueError) as error:
            print(f'{title}, unit {unit}: {model} refuses: {error}', file=sys.stderr, flush=True)
            refused = str(error) if model == 'fit' else refused
            continue
        if model == 'fit':
            fit_s = time.process_time() - began
            chosen, done[study.label] = chosen_by(calibration), calibration
        for test, result in scored(study, calibration, tests).items():
            scores[test][model] = result
    if has_baselines and not all(known.values()):
        for model, correct in scipy_baselines(study).items():
            for test, bags in tests.items():
                forces = [correct(bag) for bag in bags]
                scores[test][model] = error_of(forces, bags, is_drift=study.is_drift)
    return [
        Result(titles[test], unit, {**by_model, **known[test]}, chosen, fit_s, refused)
        for test, by_model in scores.items()
    ]


def studies_of(case: str, unit: int, path: Path | None) -> Iterator[Study]:
    """Return the studies of one unit of a case."""
    if case != 'cats':
        return samples(case) if case in RECORDED else CASES[case][0](unit)
    assert path is not None
    return cats(path)


def run_case(
    case: str,
    label: str,
    units: int,
    path: Path | None,
    earlier: Mapping[tuple[str, int], Mapping[str, Score]],
) -> list[Result]:
    """Run all studies of a case or, with a label, one study and the study of its prior."""
    results = []
    for unit in range(1, (1 if case in RECORDED else units or CASES[case][1]) + 1):
        done: dict[str, thermo_comp.Calibration] = {}
        studies = list(studies_of(case, unit, path))
        needed = {study.prior_of for study in studies if study.label == label}
        seen = Counter[str]()
        for study in studies:
            if not label or study.label == label or study.label in needed:
                # Studies with equal labels hold out different bags: number them like units.
                number = unit + seen[study.label]
                seen[study.label] += 1
                print(f'{case} {study.label}, unit {number}', file=sys.stderr, flush=True)
                results += run(case, number, study, done, earlier)
    return results


def baselines_in(path: Path) -> dict[tuple[str, int], dict[str, Score]]:
    """Read the scores of the baselines from a JSON file of an earlier run."""
    scores: dict[tuple[str, int], dict[str, Score]] = {}
    for unit in json.loads(path.read_text(encoding='utf-8'))['units']:
        scores[unit['title'], unit['unit']] = {
            model: Score(**score) for model, score in unit['scores'].items() if model in BASELINES
        }
    return scores


HEAD = (
    '| row | fit: norm / vector | ratio: norm / axes / worst | claim | '
    + ' | '.join(BASELINES)
    + ' | fit CPU s | chosen | |\n'
    + '|---' * (len(BASELINES) + 7)
    + '|'
)


def pair(score: Score | None) -> str:
    """Format a model's error of the norm and of the vector [ug]."""
    if score is None:
        return '-'
    return ' / '.join('-' if np.isnan(x) else f'{x:.3g}' for x in (score.norm, score.vector))


def line_of(row: Row, missed: Sequence[str]) -> str:
    """Format a row of the table."""
    fit = row.scores.get('fit', Score())
    ratios = ' / '.join(
        '-' if np.isnan(x) else f'{x:.2f}' for x in (fit.norm_ratio, fit.ratio, row.worst)
    )
    cells = [row.title, pair(row.scores.get('fit')), ratios, f'{fit.claim:.3g}']
    cells += [pair(row.scores.get(model)) for model in BASELINES]
    bound = '' if np.isnan(fit.bound_ratio) else f'bias / bound {fit.bound_ratio:.2f}; '
    marks = '; '.join(f'MISS {text}' for text in missed)
    cells += [f'{row.fit_s:.1f}', row.refused or row.chosen, bound + marks]
    return '| ' + ' | '.join(cells) + ' |'


def main() -> int:
    """Run the selected cases."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = (*RECORDED, *CASES)
    parser.add_argument('--cases', type=lambda text: text.split(','), default=list(names),
                        help=f'default: all of {", ".join(names)}')  # fmt: skip
    parser.add_argument('--units', type=int, default=0, help='units per case; default: 3 to 100')
    parser.add_argument('--cats', type=Path, help='cats_temperature_calib.nc (needs h5py)')
    parser.add_argument('--baselines', type=Path, metavar='JSON',
                        help='reads scores of the baselines from a --json file')  # fmt: skip
    parser.add_argument('--json', type=Path, help='file for all figures')
    options = parser.parse_args()
    wanted = [name.partition(':')[::2] for name in options.cases]
    for case, _ in wanted:
        if case not in names:
            parser.error(f'--cases: {case!r} is none of {", ".join(names)}')
    if options.cases == list(names) and options.cats is None:
        print('The case cats is left out: it needs --cats FILE.', file=sys.stderr)
        wanted.remove(('cats', ''))
    if options.cats is None and any(case == 'cats' for case, _ in wanted):
        parser.error('--cases: cats needs --cats FILE')
    earlier = baselines_in(options.baselines) if options.baselines else {}
    results, printed = [], []
    print(HEAD, flush=True)
    for case, label in wanted:
        of_case = run_case(case, label, options.units, options.cats, earlier)
        if not of_case:
            parser.error(f'--cases: {case} has no study {label!r}')
        rows = rows_of(of_case)
        for row in rows:
            missed = misses(row, rows)
            print(line_of(row, missed), flush=True)
            printed.append({**asdict(row), 'missed': missed})
        results += of_case
        if options.json:
            # Write the figures after each case: a run of all cases takes hours.
            figures = {
                'version': thermo_comp.__version__,
                'rows': printed,
                'units': [asdict(result) for result in results],
            }
            options.json.write_text(json.dumps(figures, indent=1), encoding='utf-8')
    n_missed = sum(bool(row['missed']) for row in printed)
    print(f'\n{n_missed} of {len(printed)} rows violate a limit')
    return int(n_missed > 0)


if __name__ == '__main__':
    sys.exit(main())
