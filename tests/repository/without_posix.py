"""The program on this system, without what Windows has not: ``python without_posix.py COMMAND …``.

Modules that only POSIX has are not found, functions and flags of theirs are not there. What other
things Windows does otherwise is not tried by this.
"""

import importlib.abc
import os
import sys

MODULES = ("fcntl", "termios", "tty", "pty", "pwd", "grp", "resource", "readline", "curses")
#: But for those that other packages need because they see a Linux (os.uname of NumPy).
OF_OS = ("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "pread", "pwrite", "getuid",
         "geteuid", "getloadavg", "sched_getaffinity", "sched_setscheduler", "sched_getscheduler",
         "fork", "killpg", "setsid", "register_at_fork")  # fmt: skip


class NotFound(importlib.abc.MetaPathFinder):
    """Finds the modules of POSIX, and says that there are none."""

    def find_spec(self, fullname, path=None, target=None):
        if fullname in MODULES:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)


if __name__ == "__main__":
    for name in MODULES:
        sys.modules.pop(name, None)
    sys.meta_path.insert(0, NotFound())
    for name in OF_OS:
        if hasattr(os, name):
            delattr(os, name)

    from trms_cli.cli import main

    sys.exit(main(sys.argv[1:]))
