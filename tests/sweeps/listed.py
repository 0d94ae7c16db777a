"""Points that are proposed in their order, some at a time."""

from trms_cli.sweeps.space import SweepPoint


class Listed:
    """Proposes a number of points, some at a time."""

    def __init__(self, count: int, begun: int = 0) -> None:
        self.total, self._next, self.told = count, begun, []

    def more(self, results, count):
        self.told += results
        first, self._next = self._next, min(self.total, self._next + max(count, 0))
        return [SweepPoint(n, (f"seed={n}",)) for n in range(first, self._next)]

    def summary(self, results):
        return {}
