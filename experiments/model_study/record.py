"""The record of a real rig: its first part fitted, the rest judged, never the other way round."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from experiments.model_study.fits import Fitted, fit, fit_all
from experiments.model_study.judgement import Judgement, judge
from experiments.model_study.study import FormSettings, RecordSettings

FILE = "closed_loop.csv"
#: The model of the rig's maker, which says whether the record can be taken.
_OWN = "tras"


@dataclass(frozen=True)
class RecordResult:
    """What came out on the record."""

    fits: dict[str, Fitted]
    judgements: dict[str, Judgement]  #: Of all models, on the part that was not fitted
    forms: dict[str, Judgement]  #: The two forms of the beam, driven by the measured rotors
    form_fits: dict[str, Fitted]


def judge_record(
    record: Path, settings: RecordSettings, horizons: list[float], folder: Path
) -> RecordResult:
    """Fit and judge.

    ``record``: the folder with :data:`FILE`. ``folder``: of the fits.
    """
    source = [f"real='{record / FILE}'", *settings.data]
    first, rest = [*source, f"data.end={settings.split}"], [*source, f"data.start={settings.split}"]
    fits = fit_all(settings.models, first, folder)
    models = {name: fitted.model for name, fitted in fits.items() if fitted.model}
    judgements = judge(models, rest, horizons, _OWN)
    form_fits = {
        name: fit(form_words(name, settings.forms), first, folder / f"form_{name}")
        for name in settings.forms.models
    }
    driven = [*rest, f"driven={settings.forms.driven}", *settings.forms.data]
    forms = judge({n: f.model for n, f in form_fits.items() if f.model}, driven, horizons, _OWN)
    return RecordResult(fits, judgements, forms, form_fits)


def form_words(model: str, settings: FormSettings) -> list[str]:
    """Words of ``trms identify`` for one form."""
    priors = [f"priors.{p}={{relative_sd: {settings.relative_sd}}}" for p in settings.free]
    free = f"free=[{','.join(settings.free)}]"
    own = [f"model={model}", "method=multiple_shooting", free, f"driven={settings.driven}"]
    return [*own, *priors, "validation.share=0", *settings.data]
