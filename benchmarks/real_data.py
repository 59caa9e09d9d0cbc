# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
Owns docs/real_data.md: what the tools say of recordings that other people made.

    python benchmarks/real_data.py

reads the recordings from ``$THERMO_COMP_DATA`` or ``../shared/data`` and writes the page with its
plots; without the recordings it says so and changes nothing.

"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from recorded import ROOT, data_folder

UNITS = (0, 1, 2)


def main() -> int:
    """
    Write the page, or say why not.

    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--docs', type=Path, default=ROOT / 'docs', help='where the page goes')
    docs = parser.parse_args().docs
    folder = data_folder()
    if not folder.is_dir():
        print(f'skipped: the recordings are not in {folder} (set THERMO_COMP_DATA)')
        return 0
    plots = docs / 'figures'
    plots.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        text = make(folder, Path(scratch), plots)
    (docs / 'real_data.md').write_text(text, encoding='utf-8')
    print(f'{docs / "real_data.md"}: written')
    return 0


def make(folder: Path, work: Path, plots: Path) -> str:
    """
    Compute everything, plot it, return the page.

    """
    from recorded import figures, page
    from recorded.data import FREEZER, freezer_bag, freezer_column
    from recorded.faces import read_faces
    from recorded.freezer import coarser, forecast, interleaved, ours, read_freezer, track
    from recorded.handheld import read_handheld
    from recorded.null import freezer_under_another_unit, small_spans, wrong_units

    from thermo_comp.convert import load_column_map, table_log

    bag = freezer_bag(folder, work)
    freezer = read_freezer(folder, bag)
    for line in page.said_steps(freezer):
        print(line)
    tracked = track(freezer)
    coarse = track(freezer, coarser(freezer.pose.detector, 0.3))
    units = [read_handheld(folder, work, unit) for unit in UNITS]
    faces = read_faces(folder, work)
    clock = freezer_column(folder, 'now[ms]') * 1e-3
    columns = load_column_map(ROOT / 'config' / 'columns' / 'freezer.yaml')
    accel = table_log(folder / FREEZER, columns).accel
    names = {
        'regime': figures.regime_figure(tracked, coarse, plots),
        'thermometer': figures.thermometer_figure(tracked, plots),
        'branches': figures.branches_figure(freezer, plots),
        'jumps': figures.jumps_figure(freezer, clock, accel * columns.accel.factor, plots),
        'held_out': figures.held_out_figure(
            freezer,
            ours(freezer, interleaved(freezer), extend=True)[0],
            ours(freezer, forecast(freezer), extend=True)[0],
            plots,
        ),
        'handheld': figures.handheld_figure(units, plots),
    }
    names = {key: f'figures/{name}' for key, name in names.items()}
    bags = {unit.unit: work / f'handheld{unit.unit}.mcap' for unit in units}
    by_number = {unit.unit: unit for unit in units}
    return '\n'.join(
        (
            page.HEAD,
            page.freezer_section(freezer, names),
            page.held_out_section(freezer, names),
            page.thermal_section(tracked, coarse, names),
            page.handheld_section(units, names),
            page.faces_section(faces),
            page.null_section(
                small_spans(bag),
                wrong_units(bags, by_number, work),
                freezer_under_another_unit(bag, units[0]),
            ),
        )
    )


if __name__ == '__main__':
    sys.exit(main())
