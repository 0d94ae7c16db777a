"""What the validation's tests share lies in known_rig.py."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
