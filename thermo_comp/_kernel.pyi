# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
from thermo_comp.typing import Floats, Stamps

def correct(
    start_ns: Stamps,
    counts: Stamps,
    columns: Floats,
    stamps: Stamps,
    samples: Floats,
    out: Floats,
    misalignment: tuple[float, ...],
    /,
) -> tuple[tuple[float, float, float], tuple[float, float, float]]: ...
