"""A folder for a rig of one's own: model, driver, configuration, tests, ready to run.

What is written are the files under ``rig_templates``: those of ``common`` for every rig, those of
an example for its equation and signals. ``examples/`` in the source is made of them, too.
"""

import keyword
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path

from trms_cli.composition.catalogue import read_groups
from trms_cli.composition.rig_folder import FILE
from trms_cli.core import trust
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

_TEMPLATES = Path(__file__).with_name("rig_templates")
_SUFFIX, _DOT = ".in", "dot_"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
#: What lies beside the package in its folder.
_TAKEN = ("configs", "tests", "outputs")

#: What the templates say of an example.
EXAMPLES: Mapping[str, Mapping[str, str]] = {
    "servo_drive": {
        "TITLE": "linear servo drive without dry friction",
        "TITLE_SENTENCE": "A servo drive",
        "DESCRIPTION": "one current, one position; dry friction is what the model lacks",
        "INPUT": "current",
        "INPUT_UNIT": "A",
        "LIMIT": "5",
        "DRIVE": "drive",
        "CHANNELS": '"encoder"',
        "COLUMNS": "current[A],position[m]",
        "RMSE": "0.05",
    },
    "cart_pole": {
        "TITLE": "cart with a pendulum, upright at zero",
        "TITLE_SENTENCE": "A cart with a pendulum",
        "DESCRIPTION": "one force, a position and an angle that is unstable upright",
        "INPUT": "force",
        "INPUT_UNIT": "N",
        "LIMIT": "10",
        "DRIVE": "drive",
        "CHANNELS": '"rail", "joint"',
        "COLUMNS": "force[N],position[m],angle[rad]",
        "RMSE": "0.1",
    },
}


@dataclass(frozen=True)
class NewRig:
    """What was written."""

    folder: Path
    package: str
    files: tuple[Path, ...]  #: relative to the folder
    allowed: bool  #: whether the list of allowed packages could be written


def new_rig(folder: Path, example: str = "servo_drive") -> NewRig:
    """Write the folder of a rig, which is called as the folder is, and allow its package.

    The folder appears whole, or not at all.

    Raises ConfigurationError for a name that no package can have, or that another has; for a folder
    that holds something; and where nothing can be written.
    """
    if example not in EXAMPLES:
        raise ConfigurationError(
            f"there is no example {example!r}", where="example", remedy=nearest(example, EXAMPLES)
        )
    folder = folder.expanduser().absolute()
    package = folder.name
    _check_name(package)
    _check_place(folder)
    allowed = trust.allowed_for_good()
    if package in allowed and allowed[package] != folder:
        raise ConfigurationError(
            f"{package} is allowed already, in another place: {allowed[package] or 'installed'}",
            where="trms init",
            remedy=f"take another name, or first: trms allow --remove {package}",
        )
    texts = rig_files(package, example)
    try:
        _write(folder, texts)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror or error}",
            where=str(folder),
            remedy="name a place that you can write to: trms init PLACE/NAME",
        ) from error
    try:
        trust.write_allowed({**allowed, package: folder})
    except OSError:
        return NewRig(folder, package, tuple(texts), allowed=False)
    return NewRig(folder, package, tuple(texts), allowed=True)


def rig_files(package: str, example: str) -> dict[Path, str]:
    """The files of a rig by their places in its folder."""
    values = {
        "RIG": package,
        "CLASS": "".join(part[:1].upper() + part[1:] for part in package.split("_")),
        "DISTRIBUTION": package.replace("_", "-").strip("-"),
        **EXAMPLES[example],
    }
    texts = {}
    for part in ("common", example):
        for file in sorted((_TEMPLATES / part).rglob(f"*{_SUFFIX}")):
            place = file.relative_to(_TEMPLATES / part).as_posix().removesuffix(_SUFFIX)
            names = [re.sub(f"^{_DOT}", ".", name) for name in place.split("/")]
            texts[Path(_filled("/".join(names), values))] = _filled(file.read_text("utf-8"), values)
    return texts


def _filled(text: str, values: Mapping[str, str]) -> str:
    return re.sub(r"@([A-Z_]+)@", lambda match: values[match[1]], text)


def _check_name(package: str) -> None:
    where, remedy = "trms init", "a package's name: letters, digits and _, as my_rig"
    if not _NAME.fullmatch(package) or keyword.iskeyword(package):
        kind = "is a word of Python" if keyword.iskeyword(package) else "is no package's name"
        raise ConfigurationError(f"{package!r} {kind}", where=where, remedy=remedy)
    if package in sys.stdlib_module_names or package == "trms_cli":
        owner = "this program" if package == "trms_cli" else "Python"
        raise ConfigurationError(
            f"{package} is a package of {owner}", where=where, remedy="take another name"
        )
    if package in _TAKEN:
        raise ConfigurationError(
            f"{package!r} is a folder beside the package", where=where, remedy="take another name"
        )
    spec = PathFinder.find_spec(package)
    if spec is not None and spec.origin is not None:
        raise ConfigurationError(
            f"a package {package} is installed already, and would be taken in its place",
            where=spec.origin,
            remedy="take another name",
        )
    if package in read_groups()["model"]:
        raise ConfigurationError(
            f"there is a model {package} already", where=where, remedy="take another name"
        )


def _check_place(folder: Path) -> None:
    if not folder.exists() and not folder.is_symlink():
        return
    if not folder.is_dir():
        raise ConfigurationError(
            "there is a file of this name", where=str(folder), remedy="take another name"
        )
    try:
        content = next(folder.iterdir(), None)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be looked into: {error.strerror or error}",
            where=str(folder),
            remedy="name a place that you can write to",
        ) from error
    if content is not None:
        again = " (it is a rig's already)" if (folder / FILE).is_file() else ""
        raise ConfigurationError(
            f"the folder holds something{again}: {content.name}",
            where=str(folder),
            remedy="name a new folder, or an empty one",
        )


def _write(folder: Path, texts: Mapping[Path, str]) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        draft.chmod(0o755)
        for place, text in texts.items():
            (draft / place).parent.mkdir(parents=True, exist_ok=True)
            (draft / place).write_text(text, encoding="utf-8")
        draft.replace(folder)  # in place of nothing, or of an empty folder
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise
