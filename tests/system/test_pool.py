"""Worker processes of this computer."""

from __future__ import annotations

import pickle
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pool_tasks import dying, failing, scaled, slowest_first, without_pickle

from edgeperc.errors import EdgepercError
from edgeperc.evaluation.transfer import compare
from edgeperc.system.pool import MOST_KEPT, Lost, Worker, map_in_processes, map_to_workers


@pytest.mark.parametrize(("workers", "n"), [(1, 0), (2, 1), (3, 100), (None, 9)])
def test_results_come_in_order(workers: int | None, n: int) -> None:
    found = list(map_in_processes(scaled, (10,), range(n), workers=workers))
    assert [each for each in found if not isinstance(each, Lost)] == [10 * k for k in range(n) if k not in (7, 11)]
    assert len(found) == n
    for lost in found[7:8]:
        assert "ValueError: seven" in lost.reason
    for lost in found[11:12]:
        assert lost.reason == str(lost.error) == "[Errno 28] disk full"  # no traceback


def test_an_item_that_kills_its_process_is_lost_alone() -> None:
    found = list(map_in_processes(scaled, (10, (5, 6, 20)), range(30), workers=2))
    assert [k for k, each in enumerate(found) if isinstance(each, Lost)] == [5, 6, 7, 11, 20]
    assert all("died 2 times" in found[k].reason for k in (5, 6, 20))
    assert [found[k] for k in (4, 8, 19, 21, 29)] == [40, 80, 190, 210, 290]


def test_few_results_wait_for_a_slow_one() -> None:
    n = 3 * MOST_KEPT
    found = list(map_in_processes(slowest_first, (1.0,), range(n), workers=2))
    assert [item for item, _ in found] == [*range(n)]
    first = found[0][1]
    assert sum(end < first for _, end in found) < MOST_KEPT


def test_a_result_that_cannot_be_sent_is_lost() -> None:
    found = list(map_in_processes(without_pickle, (), range(3), workers=1))
    assert (found[0], found[2]) == (0, 2)
    assert "pickle" in found[1].reason


class Fragile(Worker):
    """A process that takes what it has done with it when it dies of an item."""

    def __init__(self, deadly: set[int]) -> None:
        super().__init__()
        self.deadly, self.done = deadly, 0

    @property
    def end(self) -> Any:
        return self if self.numbers or not self.has_begun else None

    def begin(self, item: bytes) -> None:
        pass

    def answer(self) -> bytes:
        if self.deadly & {*self.numbers}:
            raise EOFError
        self.done += self.has_begun
        return pickle.dumps(10 * self.numbers[0] if self.has_begun else None)

    def died_of(self) -> Sequence[int]:
        return self.numbers

    def stop(self) -> None:
        pass


@pytest.mark.parametrize("n_workers", [1, 2, 3])
@pytest.mark.parametrize("deadly", [{0}, {4}, {4, 5}, {19}])
def test_items_before_one_that_kills_its_process_are_not_lost(deadly: set[int], n_workers: int) -> None:
    for wait in (lambda ends: ends, lambda ends: ends[:1], lambda ends: ends[-1:]):
        found = [*map_to_workers(lambda: Fragile(deadly), wait, range(20), n_workers)]
        assert {k for k, each in enumerate(found) if isinstance(each, Lost)} == deadly
        assert [each for each in found if not isinstance(each, Lost)] == [10 * k for k in range(20) if k not in deadly]


@pytest.mark.parametrize(("n_items", "done"), [(2, [1, 1]), (3, [1, 2]), (40, [20, 20])])
def test_no_worker_waits_while_another_has_two_items(n_items: int, done: list[int]) -> None:
    """Of two drives, one process did both, and the other one nothing."""
    workers: list[Fragile] = []

    def start() -> Fragile:
        workers.append(Fragile(set()))
        return workers[-1]

    assert [*map_to_workers(start, lambda ends: ends, range(n_items), 2)] == [10 * k for k in range(n_items)]
    assert sorted(worker.done for worker in workers) == done


@pytest.mark.parametrize(("make", "message"), [(failing, "no such model"), (dying, "exit code 4")])
def test_what_cannot_start_is_an_error(make: Callable[[], Callable[[int], int]], message: str) -> None:
    with pytest.raises(EdgepercError, match=message):
        list(map_in_processes(make, (), range(4), workers=2))


@pytest.mark.parametrize("is_killed", [True, False])
def test_processes_end_with_their_driver(tmp_path: Path, is_killed: bool) -> None:
    """Killed, the driver leaves no process that goes on; left early, it waits for none."""
    if not Path("/proc/self/stat").exists():
        pytest.skip("needs /proc to see processes")
    program = tmp_path / "driver.py"
    program.write_text(
        textwrap.dedent(
            """
            import os, time
            from edgeperc.system.pool import map_in_processes

            def make():
                return slow

            def slow(item):
                time.sleep(30.0 if item else 0.0)
                return os.getpid()

            if __name__ == "__main__":
                results = map_in_processes(make, (), range(8), workers=2)
                print(next(results), flush=True)
                input()
                results.close()
            """
        )
    )
    with subprocess.Popen(
        [sys.executable, program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as driver:
        pid = int(driver.stdout.readline())
        if is_killed:
            driver.kill()
        else:
            driver.stdin.write("\n")
            driver.stdin.close()
            assert driver.wait(timeout=20.0) == 0
    deadline = time.monotonic() + 20.0
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{pid}").exists()


def test_workers_give_the_same_figures_of_other_sensors() -> None:
    sets = ["vlp-16=simulation:2", "os1-64=simulation:1"]
    seen: list[tuple[int, int]] = []
    one = compare(sets)
    two = compare(sets, workers=2, on_scan=lambda done, total: seen.append((done, total)))
    np.testing.assert_equal(two, one)
    assert seen == [(8, 12), (12, 12)]
