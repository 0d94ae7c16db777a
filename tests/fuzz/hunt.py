"""One target under libFuzzer in its own process: ``python -m tests.fuzz.hunt TARGET FOLDER …``.

Any failure that is no complaint of ours is counted and its input kept in ``FOLDER/found``, once
for each place in the code, and the hunt goes on. An input that takes more than five seconds of
processor time counts as a failure. Memory and endless loops are libFuzzer's to watch: it ends.
"""

import hashlib
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import atheris

_SLOW = 5.0  # s of processor time for one input
#: Instrumented for coverage: our own code, and the readers that we give bytes to. Not Hydra: an
#: input would take a second.
_INSTRUMENTED = ["trms_cli", "mcap", "yaml", "scipy.io.matlab"]


class TooSlow(Exception):
    """An input that takes too long."""


def hunt(name: str, folder: Path, arguments: list[str]) -> None:
    """Feed one target until libFuzzer's arguments say that it is enough."""
    with atheris.instrument_imports(include=_INSTRUMENTED, enable_loader_override=False):
        from tests.fuzz.target import all_targets

        target = next(target for target in all_targets() if target.name == name)
        scratch = Path(tempfile.mkdtemp(prefix=f"fuzz-{name}-"))
        seeds = target.seeds(scratch)
        for seed in seeds:  # imports what the reader imports inside; that is not its own time
            _survived(target.read, seed, scratch, folder, patience=60.0)
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        (corpus / f"seed-{hashlib.sha256(seed).hexdigest()[:16]}").write_bytes(seed)

    def one(data: bytes) -> None:
        _survived(target.read, data, scratch, folder)

    atheris.Setup([sys.argv[0], *arguments, str(corpus)], one)
    atheris.Fuzz()


def _survived(
    read: Callable[[bytes, Path], object],
    data: bytes,
    scratch: Path,
    folder: Path,
    patience: float = _SLOW,
) -> None:
    begin = time.process_time()
    try:
        read(data, scratch)
        if time.process_time() - begin > patience:
            raise TooSlow(f"{time.process_time() - begin:.1f} s")
    except Exception as error:
        _keep(error, data, folder / "found")


def _keep(error: Exception, data: bytes, folder: Path) -> None:
    """The input and its trace, unless one that fails in the same place is as short."""
    frames = traceback.extract_tb(error.__traceback__)
    places = [f"{Path(f.filename).name}:{f.lineno}" for f in frames]
    own = next((f for f in reversed(frames) if "trms_cli" in f.filename), frames[-1])
    place = f"{type(error).__name__}-{Path(own.filename).stem}-{own.name}-{own.lineno}"
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / place
    if not kept.exists() or kept.stat().st_size > len(data):
        kept.write_bytes(data)
        text = "".join(traceback.format_exception(error))[-4000:]
        Path(f"{kept}.txt").write_text(f"{text}\n{' '.join(places)}\n", encoding="utf-8")


if __name__ == "__main__":
    hunt(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])
