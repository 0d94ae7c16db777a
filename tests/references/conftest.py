"""What the tests of references share."""

import importlib.util
import platform
import sys

import pytest

#: The planner of shaped references has no wheel for Linux on other processors, and is no
#: dependency there. Anywhere else it must be installed, or the tests fail.
needs_planner = pytest.mark.skipif(
    sys.platform == "linux"
    and platform.machine() != "x86_64"
    and importlib.util.find_spec("ruckig") is None,
    reason="ruckig has no wheel for this machine",
)
