"""How many threads the linear algebra beneath NumPy takes: one.

The matrices here are small, and work is shared by processes and threads of our own: further threads
only wait for each other, on a busy machine for so long that a diagnosis takes ten times as long,
and a training fifty times. The libraries read this when NumPy is loaded, so that it is set before.
"""

import os

#: Of the environment.
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}


def take_one_thread() -> None:
    """Ask for one thread where the user does not ask for another number."""
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
