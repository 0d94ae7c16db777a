"""Where the files that travel with the program are."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent.parent


def config_folder() -> Path:
    """Return the folder of the built-in YAML groups.

    A wheel carries it inside the package; in a checkout (an editable install) it is the
    ``configs/`` beside the package, so that an edit there counts at once.
    """
    packaged = _PACKAGE / "configs"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "configs"
