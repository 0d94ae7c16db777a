"""``python -m trms_cli``: the same program as ``trms``."""

import sys

from trms_cli.cli import main

sys.exit(main())
