"""From a composed configuration to what is to be diagnosed: model, recordings, candidates."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from trms_cli.composition.catalogue import read_groups, read_yaml
from trms_cli.composition.composer import Composition
from trms_cli.composition.plain_values import model_of_choice
from trms_cli.core.errors import ConfigurationError, ModelError, RecordingError
from trms_cli.core.plugins import TARGET, build, nearest
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import ExtendedModel, effect_names
from trms_cli.gap.problem import GapProblem
from trms_cli.identification.admission import Admission, admit
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.library.tasks.subject import model_of, several
from trms_cli.models.model import Model

#: Keys of the configuration that are plugins of their own.
_GROUPS = ("model", "effect", "data")
#: Checks of an admission that hold a recording against the model.
_BY_MODEL = {"unit", "sign", "swapped", "speed", "zero", "sample time"}
#: Blocks that a recording must hold: some to fit, some to choose by, one that is sealed.
_FEWEST_BLOCKS = 4
#: s. Blocks of a recording that is long enough, and those that are too short to show anything.
_USUAL_BLOCK, _SHORTEST_BLOCK = 10.0, 5.0
#: Samples that a block must hold to be worth one.
_FEWEST_SAMPLES = 20


@dataclass(frozen=True, kw_only=True)
class DiagnoseOptions:
    """The keys of ``configs/diagnose.yaml`` that are no group."""

    real: str | tuple[str, ...]
    candidates: str | tuple[str, ...] = ("all",)
    effort: Literal["quick", "normal", "thorough"] = "normal"
    block: Annotated[float, Meta(gt=0)] | None = None  #: s
    sealed_share: Annotated[float, Meta(gt=0, lt=1)] = 0.25  #: kept aside for the verdict
    seed: Annotated[int, Meta(ge=0)] = 0
    jobs: Annotated[int, Meta(ge=1)] = 2
    out: str | None = None
    page: bool = True


@dataclass(frozen=True)
class DiagnosisRequest:
    """All that a diagnosis needs."""

    options: DiagnoseOptions
    problem: GapProblem
    candidates: Candidates
    remarks: tuple[str, ...]  #: What was found in the recordings and what was done to them

    @property
    def fingerprint(self) -> str:
        """Of all that the result depends on, hexadecimal."""
        problem = self.problem
        parts = [
            problem.model_name,
            *(f"{p.name} {p.value!r} {p.prior_sd!r}" for p in problem.model.parameters),
            repr(self.candidates.nodes),
            repr((problem.block, problem.sealed_share, problem.effort, problem.seed)),
        ]
        digest = sha256("\n".join(parts).encode())
        for dataset in problem.datasets:
            for values in (dataset.time, dataset.commands, dataset.measurements, dataset.noise_sd):
                digest.update(values.tobytes())
        return digest.hexdigest()


def request_of(composition: Composition) -> DiagnosisRequest:
    """Build what a configuration asks for.

    Raises TrmsError for the first key, recording or effect that is wrong.
    """
    config = composition.config
    own = {key: value for key, value in config.items() if key not in _GROUPS}
    options = build({TARGET: f"{__name__}.DiagnoseOptions", **own})
    assert isinstance(options, DiagnoseOptions)
    data = build(config["data"], "data")
    assert isinstance(data, DataOptions)
    model = model_of(config)
    _require_equations(model)
    words = several(options.candidates, "candidates")
    candidates = candidates_of(words, model, composition.config_dirs)
    datasets = tuple(load_datasets(several(options.real, "real"), model, data))
    admission = admit(datasets, model, len(_with_prior(model)))
    _require(admission, model_of_choice(composition))
    _require_one_rate(datasets)
    _require_blocks(datasets, options)
    problem = GapProblem(
        model=model,
        model_name=model_of_choice(composition),
        datasets=datasets,
        candidates=candidates.effects,
        block=_block(datasets, options),
        sealed_share=options.sealed_share,
        effort=options.effort,
        seed=options.seed,
        jobs=options.jobs,
        warnings=tuple(str(issue) for issue in admission.warnings),
    )
    remarks = dict.fromkeys(remark for dataset in datasets for remark in dataset.remarks)
    return DiagnosisRequest(options, problem, candidates, tuple(remarks))


def _with_prior(model: Model) -> list[str]:
    return [p.name for p in model.parameters if p.prior_sd is not None]


def _require(admission: Admission, model: str) -> None:
    """Refuse what makes every answer wrong; what does not fit a model may be of another rig."""
    try:
        admission.require()
    except RecordingError as error:
        if {issue.check for issue in admission.errors} & _BY_MODEL:
            error.remedy += f"\nif the file is right: is {model} the model of this rig?"
        raise


def _require_equations(model: Model) -> None:
    """A network steps from sample to sample: nothing in it is a place where a force could miss."""
    if model.sample_time is not None:
        raise ConfigurationError(
            f"model {model.name!r} only steps from sample to sample: a gap has no place in it",
            where="model",
            remedy="diagnose a model with equations of motion, as newtonian; `trms validate` tells "
            "how good a network is",
        )


def _require_one_rate(datasets: tuple[Dataset, ...]) -> None:
    steps = sorted({round(d.sample_time, 9) for d in datasets})
    if len(steps) > 1:
        raise ConfigurationError(
            f"the recordings have sample times of {', '.join(f'{s:g}' for s in steps)} s",
            where="real",
            remedy=f"bring them to one: data.resample={steps[-1]:g}",
        )


def _block(datasets: Sequence[Dataset], options: DiagnoseOptions) -> float:
    """Length of the blocks, s; as asked for, or such that a short recording has enough of them."""
    if options.block is not None:
        return options.block
    length = sum(dataset.duration for dataset in datasets)
    return max(_SHORTEST_BLOCK, min(_USUAL_BLOCK, length / (_FEWEST_BLOCKS + 1)))


def _require_blocks(datasets: tuple[Dataset, ...], options: DiagnoseOptions) -> None:
    """Some blocks to fit, some to choose by, and one at least that is sealed."""
    step = datasets[0].sample_time
    block = _block(datasets, options)
    if block < _FEWEST_SAMPLES * step:
        raise ConfigurationError(
            f"a block of {block:g} s holds {block / step:.0f} samples",
            where="block",
            remedy=f"give at least {_FEWEST_SAMPLES * step:g} s; 5 to 15 s suit most rigs",
        )
    whole = sum(int(d.duration / block + 1e-6) for d in datasets)
    if whole < _FEWEST_BLOCKS:
        length = sum(d.duration for d in datasets)
        raise ConfigurationError(
            f"{length:g} s recorded hold {whole} blocks of {block:g} s, and "
            f"{_FEWEST_BLOCKS} are needed: to fit, to choose by, and to be sealed",
            where="real",
            remedy=f"record at least {_FEWEST_BLOCKS * block:g} s, better 120 s"
            + (
                f"; or shorter blocks: block={length / _FEWEST_BLOCKS:.3g}"
                if length / _FEWEST_BLOCKS >= max(5.0, _FEWEST_SAMPLES * step)
                else ""
            ),
        )


#: The group of the effects, and the word for all of them.
_GROUP, _ALL = "effect", "all"


@dataclass(frozen=True)
class Candidates:
    """Effects that may be the cause."""

    effects: Mapping[str, Effect]  #: At the sizes of their options
    nodes: Mapping[str, Mapping[str, Any]]  #: What the options say: class and arguments


def candidates_of(
    words: Sequence[str], model: Model, config_dirs: Sequence[Path] = ()
) -> Candidates:
    """The effects that ``candidates`` names, as far as the model can carry them.

    ``words``: ``all``, names, patterns, and any of these after ``!`` to leave out again. ``model``:
    the nominal one; an effect that it has already is no candidate. ``config_dirs``: the user's
    folders; an option there hides a built-in namesake.

    Raises ConfigurationError for a name or pattern that fits nothing, an option that is no effect,
    or a list that leaves nothing, and ModelError for an effect that is asked for by its name and
    that the model cannot carry.
    """
    library = effect_nodes(config_dirs)
    effects: dict[str, Effect] = {}
    left_out: dict[str, str] = {}
    present = effect_names(model)
    for name in _chosen(words, library):
        if name in present:
            left_out[name] = "the nominal model has it already"
            continue
        effect = build(library[name], f"{_GROUP}.{name}")
        if not isinstance(effect, Effect):
            raise ConfigurationError(
                f"{library[name][TARGET]!r} is no effect",
                where=f"{_GROUP}.{name}",
                remedy=f"derive it from trms_cli.effects.effect.Effect, or leave it out: !{name}",
            )
        try:
            ExtendedModel(model, name, effect)
        except ModelError as error:
            if name in words:
                raise
            left_out[name] = error.problem
            continue
        effects[name] = effect
    if not effects:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise ConfigurationError(
            "no effect is left to be suspected" + (f" ({reasons})" if reasons else ""),
            where="candidates",
            remedy="candidates=[all], or names that `trms list effect` shows",
        )
    return Candidates(effects, {name: library[name] for name in effects})


def effect_nodes(config_dirs: Sequence[Path] = ()) -> dict[str, dict[str, Any]]:
    """All effects in the search path, by the name under which a model gains them."""
    nodes: dict[str, dict[str, Any]] = {}
    for option in read_groups(config_dirs).get(_GROUP, {}).values():
        content = read_yaml(option.file)
        for name, node in content.items() if isinstance(content, dict) else ():
            if isinstance(node, dict) and TARGET in node:
                nodes.setdefault(str(name), node)
    return dict(sorted(nodes.items()))


def _chosen(words: Sequence[str], library: Mapping[str, Any]) -> list[str]:
    """Names in the order of the library."""
    taken: set[str] = set()
    if words and all(word.startswith("!") for word in words):
        taken = set(library)  # `all` goes without saying
    for word in words:
        if word.startswith("!"):
            taken -= _fitting(word[1:], library)
        else:
            taken |= _fitting(word, library)
    return [name for name in library if name in taken]


def _fitting(word: str, library: Mapping[str, Any]) -> set[str]:
    if word == _ALL:
        return set(library)
    found = {name for name in library if fnmatch.fnmatchcase(name, word)}
    if not found:
        raise ConfigurationError(
            f"no effect is called {word!r}",
            where="candidates",
            remedy=nearest(word, [_ALL, *library]),
        )
    return found
