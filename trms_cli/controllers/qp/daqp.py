"""DAQP, under the name that configurations and logs have for it."""

from trms_cli.core.qp import Daqp

__all__ = ["Daqp"]
