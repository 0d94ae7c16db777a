"""The studies lie beside the package and are not installed: make them importable."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)

#: The studies are in the checkout only.
collect_ignore_glob = [] if find_spec("experiments") else ["*"]
