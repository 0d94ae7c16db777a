"""Several models in one command: ``model=[newtonian,fit.yaml]``, one configuration each."""

from collections.abc import Sequence
from pathlib import Path

from trms_cli.composition.checks import with_parameter_sets
from trms_cli.core.errors import ConfigurationError

_KEY = "model="


def model_list(argv: Sequence[str]) -> tuple[str, ...] | None:
    """The models of ``model=[A,B]`` as typed; None where one is chosen, or none.

    Raises ConfigurationError for an empty list, a bracket that is missing, a model that stands
    twice, or a sweep.
    """
    model_words = [word for word in argv if word.lstrip("+").startswith(_KEY)]
    if not model_words:
        return None
    value = model_words[-1].partition("=")[2].strip().strip("'\"")
    if not value.startswith("["):
        return None
    if not value.endswith("]") or "[" in value[1:]:
        raise ConfigurationError(
            f"a bracket is missing in {value!r}", where="model", remedy="'model=[NAME,FILE.yaml]'"
        )
    names = tuple(name.strip().strip("'\"") for name in value[1:-1].split(",") if name.strip())
    if not names:
        raise ConfigurationError(
            "no model is named", where="model", remedy="'model=[NAME,FILE.yaml]', or model=NAME"
        )
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ConfigurationError(
                f"{name} stands twice in {value}", where="model", remedy="name each once"
            )
    if "-m" in argv or "--multirun" in argv:
        raise ConfigurationError(
            f"a list of models ({value}) is compared in one validation, a sweep makes several",
            where="model",
            remedy=f"leave out -m, or sweep: model={','.join(names)}",
        )
    return names


def one_of(argv: Sequence[str], name: str) -> list[str]:
    """The command line with one model in the list's place.

    A parameter set that is no model (``tras_record``) stands for its file, which names its model.
    """
    rest = [word for word in argv if not word.lstrip("+").startswith(_KEY)]
    return named_sets([f"{_KEY}{name}", *rest])


def named_sets(argv: Sequence[str]) -> list[str]:
    """The command line with its file for a parameter set that is chosen as the model."""
    from trms_cli.composition.catalogue import read_groups, take_config_dirs

    return with_parameter_sets(argv, read_groups(take_config_dirs(argv)[0]))


def shown_names(model_names: Sequence[str]) -> list[str]:
    """What models are called in tables: a file's stem, or, where stems repeat, its path.

    Every fit is called ``model.yaml``; it goes by the name of its folder.
    """
    stems = [
        _stem(Path(name)) if name.endswith((".yaml", ".yml")) else name for name in model_names
    ]
    return [
        stem if stems.count(stem) == 1 else name
        for stem, name in zip(stems, model_names, strict=True)
    ]


def _stem(path: Path) -> str:
    return path.parent.name if path.stem == "model" and path.parent.name else path.stem
