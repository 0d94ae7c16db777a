"""Turns at what one thread may do at a time."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from trms_cli.core.threads import Turn


def test_a_turn_is_one_threads_and_may_be_taken_again():
    turn, inside, most = Turn(), 0, 0

    @turn
    def nested() -> None:
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        with turn:
            assert turn.is_mine
        assert turn.is_mine
        inside -= 1

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: [nested() for _ in range(500)], range(4)))
    assert most == 1 and not turn.is_mine


def test_others_work_while_a_turn_is_passed_on():
    turn, worked = Turn(), threading.Event()

    def other() -> None:
        with turn:
            worked.set()

    with turn, turn:
        thread = threading.Thread(target=other)
        thread.start()
        assert not worked.wait(0.05)
        with turn.passed_on():
            assert worked.wait(10) and not turn.is_mine
        assert turn.is_mine
    thread.join()
    with turn.passed_on():  # of one that has none
        assert not turn.is_mine


def test_an_error_gives_the_turn_back():
    turn = Turn()
    with pytest.raises(ValueError), turn, turn.passed_on():
        raise ValueError
    assert not turn.is_mine
    with turn:
        assert turn.is_mine
