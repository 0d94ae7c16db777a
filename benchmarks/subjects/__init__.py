"""Subjects of the benchmark: each a module with ``TITLE`` and ``run(options) -> list[Table]``."""
