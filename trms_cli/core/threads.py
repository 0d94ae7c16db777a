"""Threads: one for linear algebra, one at a time for symbols.

The matrices here are small, and work is shared by processes and threads of our own: further threads
of the libraries beneath NumPy only wait for each other, on a busy machine for so long that a
diagnosis takes ten times as long, and a training fifty times. The libraries read their number when
NumPy is loaded, so that it is set before.

CasADi lets go of the interpreter's lock in every call, and expressions that two threads build at
once end the process: with CasADi 3.8.2, threads that do nothing but build Jacobians crash within
seconds. Whatever builds symbols in a thread waits for its turn.
"""

import os
from collections.abc import Iterator
from contextlib import ContextDecorator, contextmanager
from threading import Lock, get_ident

#: Of the environment.
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}


def take_one_thread() -> None:
    """Ask for one thread where the user does not ask for another number."""
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)


class Turn(ContextDecorator):
    """A lock that its thread may take again, and let go of while it waits for something else."""

    def __init__(self) -> None:
        self._lock, self._owner, self._depth = Lock(), 0, 0

    @property
    def is_mine(self) -> bool:
        """Whether it is the calling thread's."""
        return self._owner == get_ident()

    def __enter__(self) -> None:
        if not self.is_mine:
            self._lock.acquire()
            self._owner = get_ident()
        self._depth += 1

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if not self._depth:
            self._owner = 0
            self._lock.release()

    @contextmanager
    def passed_on(self) -> Iterator[None]:
        """Others may have it inside, however deep the calling thread has taken it."""
        if not self.is_mine:
            yield
            return
        depth, self._depth, self._owner = self._depth, 0, 0
        self._lock.release()
        try:
            yield
        finally:
            self._lock.acquire()
            self._depth, self._owner = depth, get_ident()


#: Of whoever builds, differentiates or writes out CasADi's expressions where other threads may.
#: Evaluation of a finished function needs none.
SYMBOLS = Turn()
