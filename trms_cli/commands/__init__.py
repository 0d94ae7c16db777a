"""One thin file a command: configuration or options → a domain call → table, files, exit code.

A command's module has a ``SUMMARY`` (one line), a ``HELP`` (what ``trms COMMAND --help`` prints)
and ``main(argv) -> int``, which gets what follows the command word and returns the exit code.
A command that composes an experiment also names its primary configuration: ``COMPOSES = "run"``.
Modules import lazily: the help of a command must not wait for a solver.
"""
