"""Compiled CasADi functions: generated C, built once, cached by content.

A function that runs in a loop is written to C, built with the machine's compiler into a shared
library in the user's cache folder, and loaded from there the next time. Without a compiler the
same function runs in CasADi's virtual machine: slower by a factor of three to five, equal in
result to rounding.
"""

import atexit
import ctypes
import functools
import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.arrays import FloatArray
from trms_cli.core.threads import SYMBOLS

#: Of code that follows from a model: long, mostly without loops, and new with each effect. More
#: than -O1 takes twice the time, and makes closed loops no faster. ``-ffp-contract=off`` keeps
#: every operation as it is written: adding a term that is zero leaves all bits as they were, and
#: any level of optimisation gives the same numbers. No ``-march=native``: a cache folder may be
#: shared by the machines of a cluster.
COMPILER_FLAGS = ("-O1", "-fPIC", "-shared", "-ffp-contract=off")
#: Of C that is written by hand: short, and full of loops.
_OF_LOOPS = ("-O2", "-ftree-vectorize", *COMPILER_FLAGS[1:])
_ENVIRONMENT_SWITCH = "TRMS_COMPILE"  # "0" turns compilation off
_MORE_FLAGS = "TRMS_CFLAGS"  # after ours
#: s that a compiler may take before somebody at a terminal is told.
_LONG = 1.0
#: Functions that a process keeps at hand; each may be that of many runs.
_MOST_LOADED = 128


def cache_folder() -> Path:
    """Folder of the compiled functions (``TRMS_CACHE`` or the platform's user cache)."""
    override = os.environ.get("TRMS_CACHE")
    if override:
        return Path(override)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "trms" / "functions"
    except RuntimeError:  # a user without a name and a home, as in many containers
        return _folder_of_process() / "functions"


@functools.cache
def _folder_of_process() -> Path:
    """A cache for this process alone; one that others may know the name of, they could fill."""
    folder = tempfile.mkdtemp(prefix="trms-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


@functools.cache
def compiler() -> str | None:
    """Path of the C compiler (``CC`` or the first of cc, gcc, clang), or None."""
    if os.environ.get(_ENVIRONMENT_SWITCH) == "0":
        return None
    candidates = [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]
    for name in candidates:
        path = shutil.which(name)
        if path:
            return path
    return None


def compile_function(function: ca.Function) -> ca.Function:
    """The function as machine code where there is a compiler, else as it is.

    ``function``: its name must be a valid C identifier. Outputs are made dense.

    The cache key is the SHA-256 of the serialised function, CasADi's version and the compiler's
    flags. Two processes that build at once do not disturb each other: a library is written
    beside its place and renamed.
    """
    program = compiler()
    return function if program is None else _loaded(function, program, cache_folder())


@functools.lru_cache(maxsize=_MOST_LOADED)
def _loaded(function: ca.Function, program: str, folder: Path) -> ca.Function:
    """See :func:`compile_function`. A function never changes: the second call has it at once."""
    library = _library([function], "")
    return function if library is None else ca.external(function.name(), str(library))


def compiled_library(functions: Sequence[ca.Function], driver: str) -> ctypes.CDLL | None:
    """Functions and C code that calls them, as one loaded library; None without a compiler.

    A loop around a model's step costs a Python call a step; as C beside the generated functions
    it costs nothing, and it runs without the interpreter's lock.

    ``functions``: with dense inputs and outputs. ``driver``: C source put after them. Each function
    is there as ``int NAME(const double** arg, double** res, long long* iw, double* w, int mem)``.
    """
    library = _library(functions, driver)
    return None if library is None else ctypes.CDLL(str(library))


@functools.cache
def compiled_source(name: str, source: str) -> ctypes.CDLL | None:
    """C code of our own as a loaded library; None without a compiler.

    ``name``: a valid C identifier, for the file in the cache. ``source``: needs nothing but libm.
    """
    library = _library([], source, name)
    return None if library is None else ctypes.CDLL(str(library))


@SYMBOLS
def _library(functions: Sequence[ca.Function], driver: str, name: str = "") -> Path | None:
    """Functions with the C code beside them; see :func:`build_library`."""
    name = name or functions[0].name()

    def write(folder: Path) -> Path:
        source = folder / f"{name}.c"
        generator = ca.CodeGenerator(source.name)
        for function in functions:
            generator.add(function)
        generator.generate(f"{folder}{os.sep}")
        if driver:
            with source.open("a", encoding="utf-8") as stream:
                stream.write(driver)
        return source

    content = [*(function.serialize() for function in functions), driver]
    return build_library(name, content, COMPILER_FLAGS if functions else _OF_LOOPS, write)


def build_library(
    name: str, content: Iterable[str], flags: Sequence[str], write: Callable[[Path], Path]
) -> Path | None:
    """File of a compiled source in the cache, built if need be; None where that cannot be done.

    ``name``: begins that of the file. ``content``: all that the source follows from. ``write``:
    writes the source into a folder, and says where.
    """
    program = compiler()
    library = _place(name, content, flags)
    if program is None or library is None or library.exists():
        return library
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
            source, binary = write(Path(scratch)), Path(scratch) / library.name
            command = [program, *_with_more(flags), "-o", str(binary), str(source), "-lm"]
            with SYMBOLS.passed_on(), _saying(name):
                subprocess.run(command, check=True, capture_output=True)
            os.replace(binary, library)
    except (OSError, subprocess.CalledProcessError):
        # An unwritable cache or a broken compiler costs speed, never the run.
        return None
    return library


@contextmanager
def _saying(name: str) -> Iterator[None]:
    """Tell a person at a terminal what is waited for, where it takes long."""
    if not sys.stderr.isatty():
        yield
        return
    words = f"compiling {name}: once, it is kept in {cache_folder()}\n"
    timer = threading.Timer(_LONG, sys.stderr.write, [words])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def is_built(name: str, content: Iterable[str], flags: Sequence[str]) -> bool:
    """Whether :func:`build_library` has nothing to build."""
    library = _place(name, content, flags)
    return library is not None and library.exists()


def _place(name: str, content: Iterable[str], flags: Sequence[str]) -> Path | None:
    """Where the library of a source is; None without a compiler."""
    program = compiler()
    if program is None:
        return None
    words = [*content, ca.__version__, program, *_with_more(flags)]
    key = hashlib.sha256("\n".join(words).encode())
    return cache_folder() / f"{name}_{key.hexdigest()[:32]}.so"


def _with_more(flags: Sequence[str]) -> list[str]:
    """Flags, and those of whoever starts the program."""
    return [*flags, *shlex.split(os.environ.get(_MORE_FLAGS, ""))]


class BufferedFunction:
    """A CasADi function bound to its own input and output arrays.

    Calling it costs under a microsecond over the function itself, against 25 µs for a call with
    NumPy arrays. Write into :attr:`inputs`, call, read :attr:`outputs`; the arrays stay the same
    objects for life and are overwritten by the next call.

    ``function``: compiled here (see :func:`compile_function`) unless ``compile`` is false.
    ``inputs``: input arrays of another buffered function with the same arguments, to share them.
    """

    __slots__ = ("_buffer", "_evaluate", "function", "inputs", "outputs")

    def __init__(
        self,
        function: ca.Function,
        *,
        compile: bool = True,
        inputs: Sequence[FloatArray] | None = None,
    ) -> None:
        function = _dense(function)
        self.function = compile_function(function) if compile else function
        self._buffer, self._evaluate = self.function.buffer()
        self.inputs: tuple[FloatArray, ...] = tuple(
            inputs or (argument_array(function.size_in(i)) for i in range(function.n_in()))
        )
        self.outputs: tuple[FloatArray, ...] = tuple(
            argument_array(function.size_out(i)) for i in range(function.n_out())
        )
        for i, array in enumerate(self.inputs):
            self._buffer.set_arg(i, array.ravel(order="K").data)
        for i, array in enumerate(self.outputs):
            self._buffer.set_res(i, array.ravel(order="K").data)

    def __call__(self) -> None:
        """Evaluate from the present inputs into the outputs."""
        self._evaluate()

    def evaluate(self, *arguments: npt.ArrayLike) -> Sequence[FloatArray]:
        """Set the inputs, evaluate, and return the outputs (views, overwritten by the next)."""
        for array, value in zip(self.inputs, arguments, strict=True):
            array[...] = value
        self._evaluate()
        return self.outputs


def argument_array(size: tuple[int, int]) -> FloatArray:
    """Vectors as 1-D arrays, matrices in CasADi's column-major order."""
    rows, columns = size
    if columns == 1:
        return np.zeros(rows)
    return np.zeros((rows, columns), order="F")


@functools.lru_cache(maxsize=_MOST_LOADED)
def _dense(function: ca.Function) -> ca.Function:
    if all(function.sparsity_out(i).is_dense() for i in range(function.n_out())) and all(
        function.sparsity_in(i).is_dense() for i in range(function.n_in())
    ):
        return function
    arguments = [
        ca.MX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())
    ]
    results = function.call(arguments)
    return ca.Function(
        function.name(),
        arguments,
        [ca.densify(result) for result in results],
        function.name_in(),
        function.name_out(),
    )
