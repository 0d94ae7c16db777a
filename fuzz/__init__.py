"""Fuzzing of everything that reads a file or a line from somebody else: ``python -m fuzz --list``.

Each reader has a target in :mod:`fuzz.targets`: seeds that the program itself writes, and a call
of the reader that may end in a :class:`~trms_cli.core.errors.TrmsError` and in nothing else. What
a fuzzer has found is kept in ``fuzz/corpus/TARGET`` and replayed by the tests, without a fuzzer.
"""
