# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""Owns what the node asks of Fast DDS beyond QoS: a profile, unless the user has one."""

from __future__ import annotations

import os
from pathlib import Path

#: Where Fast DDS 2 is told of a profile. Other middlewares, and Fast DDS 3, do not look here.
VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
#: Without that it takes this file of the working directory.
LOCAL_PROFILE = 'DEFAULT_FASTRTPS_PROFILES.xml'
PROFILE = Path(__file__).with_name('fastdds_profile.xml')


def use_profile() -> None:
    """
    Make the node's profile that of this process; a profile of the user's stays.

    To be called before the first context is initialised: Fast DDS reads it once. The profile saves
    a quarter of the node's CPU time with reliable subscribers (docs/benchmarks.md).
    """
    if VARIABLE not in os.environ and not Path(LOCAL_PROFILE).is_file():
        os.environ[VARIABLE] = str(PROFILE)
