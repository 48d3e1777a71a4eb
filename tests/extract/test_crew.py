from __future__ import annotations

import threading
import time

import pytest
from vid2demo.extract.crew import Crew, usable_cpus


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order_whoever_was_first(threads: int) -> None:
    crew = Crew(threads)

    def slow_when_early(number: int) -> int:
        time.sleep(0.002 * (10 - number))
        return number**2

    assert crew.run(slow_when_early, range(10)) == [number**2 for number in range(10)]
    assert crew.run(slow_when_early, [7, 3]) == [49, 9]
    assert crew.run(slow_when_early, []) == []
    crew.close()


@pytest.mark.parametrize("threads", [1, 3])
def test_the_first_error_is_raised_when_all_is_done(threads: int) -> None:
    crew, done = Crew(threads), set()

    def fail_twice(number: int) -> None:
        done.add(number)
        if number in (2, 5):
            raise ValueError(f"number {number}")

    with pytest.raises(ValueError, match="number 2"):
        crew.run(fail_twice, range(8))
    assert done == set(range(8))
    assert crew.run(lambda number: number, range(3)) == [0, 1, 2]
    crew.close()


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_what_follows_a_job_is_done_by_the_caller_and_in_order(threads: int) -> None:
    crew, seen = Crew(threads), []

    def follow(number: int, result: int) -> int:
        assert threading.current_thread() is threading.main_thread()
        seen.append(number)
        return number + result

    assert crew.stream(lambda number: 10 * number, follow, range(6)) == [11 * number for number in range(6)]
    assert seen == list(range(6))

    def fail(number: int, result: int) -> int:
        raise ValueError(f"number {number}")

    with pytest.raises(ValueError, match="number 0"):
        crew.stream(lambda number: number, fail, range(6))
    crew.close()


def test_there_is_a_processor_to_run_on() -> None:
    assert usable_cpus() >= 1
