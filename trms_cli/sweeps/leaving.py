"""Whether the process of a worker has been told to go: a job that is preempted, or out of time."""

from __future__ import annotations

import threading

#: Set once; the run that is being made ends as interrupted, and none is begun.
leaving = threading.Event()
