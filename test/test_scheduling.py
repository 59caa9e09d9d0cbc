# SPDX-FileCopyrightText: 2026 thermo_comp contributors
# SPDX-License-Identifier: Apache-2.0
"""
The policy of the thread that waits for samples: changed where that is free, given back, kept off.

"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

import pytest

from thermo_comp.ros.scheduling import LATE_NS, LIMIT, RETRY_NS, Courtesy

if not hasattr(os, 'SCHED_BATCH'):
    pytest.skip('only Linux has SCHED_BATCH', allow_module_level=True)


def policy() -> int:
    """Tell the calling thread's own."""
    return os.sched_getscheduler(0)


def set_policy(value: int) -> None:
    """Change the calling thread's own."""
    os.sched_setscheduler(0, value, os.sched_param(0))


def in_a_thread(work: Callable[[], None]) -> None:
    """Work in a thread that nobody needs afterwards, whatever its policy is then."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]


def test_it_begins_with_a_sample_and_ends_with_the_block() -> None:
    courtesy = Courtesy()
    courtesy.note(0, 0)
    assert policy() == os.SCHED_OTHER
    for _ in range(2):
        with courtesy:
            assert policy() == os.SCHED_OTHER
            courtesy.note(0, 0)
            assert policy() == os.SCHED_BATCH
        assert policy() == os.SCHED_OTHER


def test_other_threads_stay_as_they_are() -> None:
    def work() -> None:
        with Courtesy() as courtesy:
            courtesy.note(0, 0)
            assert policy() == os.SCHED_BATCH
            assert os.sched_getscheduler(os.getpid()) == os.SCHED_OTHER  # the main thread

    in_a_thread(work)


def test_an_error_in_the_block_gives_the_policy_back() -> None:
    def fail() -> None:
        with Courtesy() as courtesy:
            courtesy.note(0, 0)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert policy() == os.SCHED_OTHER


def test_a_thread_that_comes_late_gets_the_usual_policy_until_the_next_try() -> None:
    with Courtesy() as courtesy:
        courtesy.note(0, 0)
        for _ in range(LIMIT - 1):
            courtesy.note(LATE_NS + 1, 5)
        assert policy() == os.SCHED_BATCH
        courtesy.note(LATE_NS + 1, 5)
        assert policy() == os.SCHED_OTHER
        courtesy.note(0, 5 + RETRY_NS - 1)
        assert policy() == os.SCHED_OTHER
        courtesy.note(0, 5 + RETRY_NS)
        assert policy() == os.SCHED_BATCH
        # The next try counts from nothing.
        for _ in range(LIMIT - 1):
            courtesy.note(LATE_NS + 1, 5 + RETRY_NS)
        assert policy() == os.SCHED_BATCH


def test_leaving_the_block_is_no_reason_to_try_again() -> None:
    courtesy = Courtesy()
    with courtesy:
        courtesy.note(0, 0)
        for _ in range(LIMIT):
            courtesy.note(LATE_NS + 1, 0)
    with courtesy:
        courtesy.note(0, RETRY_NS - 1)
        assert policy() == os.SCHED_OTHER


@pytest.mark.parametrize(('every', 'stays'), [(5, True), (4, True), (3, False)])
def test_it_takes_more_than_a_quarter_of_late_wake_ups(every: int, stays: bool) -> None:
    with Courtesy() as courtesy:
        courtesy.note(0, 0)
        for index in range(1000):
            courtesy.note(LATE_NS + 1 if index % every == 0 else LATE_NS, 0)
        assert (policy() == os.SCHED_BATCH) == stays


def test_a_policy_that_the_user_chose_is_left_alone() -> None:
    def work() -> None:
        set_policy(os.SCHED_IDLE)
        with Courtesy() as courtesy:
            courtesy.note(0, 0)
            assert policy() == os.SCHED_IDLE
        assert policy() == os.SCHED_IDLE

    in_a_thread(work)


@pytest.mark.parametrize('is_late', [False, True], ids=['in time', 'late'])
def test_a_policy_that_the_user_chose_meanwhile_is_left_alone(is_late: bool) -> None:
    def work() -> None:
        with Courtesy() as courtesy:
            courtesy.note(0, 0)
            set_policy(os.SCHED_IDLE)
            for _ in range(2 * LIMIT):
                courtesy.note(2 * LATE_NS if is_late else 0, 0)
            assert policy() == os.SCHED_IDLE
            courtesy.note(0, RETRY_NS)
            assert policy() == os.SCHED_IDLE
        assert policy() == os.SCHED_IDLE

    in_a_thread(work)


def test_what_the_system_refuses_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def refuse(_thread: int, value: int, _parameters: os.sched_param) -> None:
        asked.append(value)
        raise PermissionError

    monkeypatch.setattr(os, 'sched_setscheduler', refuse)
    with Courtesy() as courtesy:
        courtesy.note(0, 0)
        courtesy.note(0, RETRY_NS)
    assert asked == [os.SCHED_BATCH]


def test_a_system_without_the_policy_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, 'SCHED_BATCH')
    with Courtesy() as courtesy:
        courtesy.note(0, 0)
        assert policy() == os.SCHED_OTHER
