"""Speed and quality against peers and limits, printed as ratios: ``python -m benchmarks``.

A subject a file under :mod:`benchmarks.subjects`. Nothing in here is a test: a figure on a busy
machine says something about that machine, so figures come with it and are ratios wherever there
is something to divide by.
"""
