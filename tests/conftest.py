"""For all tests: what they find the same wherever and however they are started."""

import signal

from hypothesis import settings

from tests.browser import browser as browser  # the fixture
from trms_cli.core.threads import take_one_thread

# As the program does, before NumPy is loaded: else sums, and what follows from their last bits,
# depend on the machine's cores.
take_one_thread()

# An example of a property may take long on a busy machine, which says nothing.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# A shell starts what runs in its background with Ctrl-C ignored, and every process begins with
# what the one that started it ignores: the programs that tests interrupt would never notice.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
