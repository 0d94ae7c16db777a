"""Fuzzing of all that reads what somebody else wrote: ``python -m tests.fuzz --list``.

Each reader has a target in :mod:`tests.fuzz.targets`: seeds that the program itself writes, and a
call of the reader that may end in a :class:`~trms_cli.core.errors.TrmsError` and in nothing else.
What a fuzzer has found is kept in ``corpus/TARGET`` and replayed by the tests, without a fuzzer.
"""
