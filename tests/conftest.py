"""For all tests: what they find the same wherever and however they are started."""

import atexit
import gc
import os
import shutil
import signal
import tempfile

from hypothesis import settings

from tests.browser import browser as browser  # the fixture
from trms_cli.core.threads import take_one_thread

# As the program does, before NumPy is loaded: else sums, and what follows from their last bits,
# depend on the machine's cores.
take_one_thread()

# Figures as matplotlib is installed: neither settings of whoever starts the tests, nor a list of
# fonts that another installation has left, which sets formulas in other letters and warns of it.
# Workers and whatever tests start inherit the folder.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["MPLCONFIGDIR"] = tempfile.mkdtemp(prefix="trms-matplotlib-")
    atexit.register(shutil.rmtree, os.environ["MPLCONFIGDIR"], ignore_errors=True)

# An example of a property may take long on a busy machine, which says nothing.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# A shell starts what runs in its background with Ctrl-C ignored, and every process begins with
# what the one that started it ignores: the programs that tests interrupt would never notice.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Thousands of tests stay to the end: the collector of garbage need not look through them."""
    gc.collect()
    gc.freeze()
