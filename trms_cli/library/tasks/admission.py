"""What a model has to say of a recording that is read without one."""

from pathlib import Path

from trms_cli.composition.composer import compose
from trms_cli.composition.overrides import default_words, quote_value
from trms_cli.core.errors import TrmsError
from trms_cli.core.plugins import build
from trms_cli.identification.admission.admit import admit
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.library.tasks.subject import model_of

#: Checks that only a model can make: of a file alone nobody sees that angles are swapped.
_DOUBTS = ("swapped", "sign", "zero")
#: Models that are tried one after the other, since their inputs have other units: the one in force,
#: which is that of ``trms.toml`` in a rig's folder, and those of real rigs.
_MODELS = ((), ("model=tras",), ("model=quanser_aero",))


def doubts(file: Path) -> list[str]:
    """Sentences on what seems swapped, turned round or counted from another zero.

    None of a file that is no recording of a rig that a model is at hand for.
    """
    words = [f"real={quote_value(str(file))}"]
    for choice in _MODELS:
        argv = [*choice, *words]
        try:
            config = compose([*default_words(argv, "validate"), *argv], "validate").config
            model, data = model_of(config), build(config["data"], "data")
            assert isinstance(data, DataOptions)
            admission = admit(load_datasets(str(file), model, data), model, purpose="validation")
        except TrmsError:
            continue
        if any(issue.check not in _DOUBTS for issue in admission.errors):
            continue  # of another rig
        issues = (issue for issue in admission.issues if issue.check in _DOUBTS)
        return list(dict.fromkeys(f"{issue.problem} ({issue.remedy})" for issue in issues))
    return []
