"""The studies of rigs and models from Python, and what they give back: fits, diagnoses, …"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from trms_cli.composition.arguments import Arguments, arguments_of, text_of
from trms_cli.core.findings import Findings, Section, Table
from trms_cli.library import html
from trms_cli.library.call import call_command, call_task, words_of
from trms_cli.library.result import Paths, Result, frame_of, load_pandas
from trms_cli.library.tasks.task import Done, Listener

if TYPE_CHECKING:
    import pandas  # type: ignore[import-untyped,unused-ignore]


class StudyResult(Result):
    """What a study gives back: it shows itself by its findings."""

    @property
    def findings(self) -> Findings:
        """What is worth telling of it."""
        return self._findings()

    def _findings(self) -> Findings:
        raise NotImplementedError

    def _repr_html_(self) -> str:
        named = {key: self.folder / name for key, name in self.FILES.items()}
        written = {key: path for key, path in named.items() if path.is_file()}
        pictures = [file.read_bytes() for file in self.pictures.values()]
        findings = html.on_screen(self.findings)
        findings = replace(findings, title=findings.title or self.headline)
        return html.view(findings, pictures, {**written, "page": self.report})


class Fit(StudyResult):
    """A model fitted to recordings; ``model=fit`` takes it anywhere."""

    DOCUMENT, PAGE = "identification.json", "identification.html"
    FILES: ClassVar[Mapping[str, str]] = {"model": "model.yaml"}

    @property
    def model(self) -> Path:
        """The fitted model's file."""
        return self.file_for("model")

    @property
    def sentence(self) -> str:
        """How the fit ended."""
        return str(self.document["sentence"])

    @cached_property
    def parameters(self) -> pandas.DataFrame:
        """A row a parameter: ``value``, ``sd`` and ``unit``, where it started, its prior."""
        rows = self.document["parameters"]
        names = dict.fromkeys(key for row in rows.values() for key in row)
        columns = {name: [row.get(name) for row in rows.values()] for name in names}
        return frame_of(columns, {}, list(rows), "parameter")

    @property
    def headline(self) -> str:
        """What was fitted to what, and how it ended."""
        d = self.document
        names = ", ".join(dict.fromkeys(r["name"] for r in d["recordings"]))
        return f"{d['model']} fitted to {names} by {d['method']}: {d['sentence']}"

    def _findings(self) -> Findings:
        from trms_cli.identification.findings import findings

        return findings(self.document)


class Validation(StudyResult):
    """Models held against recordings that they were not fitted to."""

    DOCUMENT, PAGE = "validation.json", "validation.html"

    @cached_property
    def errors(self) -> pandas.DataFrame:
        """RMS of free runs: a row a model and channel, a column a horizon in s."""
        rows = {
            (name, channel): {float(h): rms for h, rms in by.items()}
            for name, document in self._models.items()
            for channel, by in document["error"].items()
        }
        horizons = sorted({h for row in rows.values() for h in row})
        columns = {h: [row.get(h) for row in rows.values()] for h in horizons}
        units = {c: u for document in self._models.values() for c, u in document["units"].items()}
        index = load_pandas().MultiIndex.from_tuples(list(rows), names=["model", "channel"])
        return frame_of(columns, units, index)

    @property
    def _models(self) -> dict[str, Any]:
        models = self.document.get("models")
        return models if models else {str(self.document["model"]): self.document}

    @property
    def headline(self) -> str:
        """Which models over which recordings."""
        over = ", ".join(recording["name"] for recording in self.document["recordings"])
        return f"{', '.join(self._models)} over {over}"

    def _findings(self) -> Findings:
        from trms_cli.identification.validation.findings import findings

        return findings(self.document)


class Stability(StudyResult):
    """What was found of a model, or of a closed loop."""

    DOCUMENT, PAGE = "stability.json", "stability.html"

    @property
    def lead(self) -> list[str]:
        """The answer, in sentences."""
        return list(self.document["lead"])

    @property
    def warnings(self) -> list[str]:
        """What to know about it."""
        return list(self.document["warnings"])

    @property
    def results(self) -> dict[str, Any]:
        """The figures; their keys are those of the study."""
        return dict(self.document["results"])

    @cached_property
    def tables(self) -> list[pandas.DataFrame]:
        """The tables, each with its caption in ``.attrs["caption"]``."""
        frames = []
        for table in self.document["tables"]:
            columns = dict(zip(table["columns"], zip(*table["rows"], strict=True), strict=False))
            frame = frame_of(columns, {})
            frame.attrs["caption"] = table["caption"]
            frames.append(frame)
        return frames

    @property
    def headline(self) -> str:
        """The study and its subject."""
        return f"{self.document['study']} of {self.document['model']}: {' '.join(self.lead)}"

    def _findings(self) -> Findings:
        d = self.document
        tables = [Table(t["columns"], t["rows"], t["caption"]) for t in d["tables"]]
        return Findings(d["title"], self.lead, [Section("", (), tables)], warnings=self.warnings)


class Diagnosis(StudyResult):
    """Where a model and a rig differ, which effect causes it, how far the gap shrinks."""

    DOCUMENT, PAGE = "diagnosis.json", "report.html"
    FILES: ClassVar[Mapping[str, str]] = {"model": "corrected_model.yaml"}

    @property
    def sentence(self) -> str:
        """The answer."""
        return str(self.document["sentence"])

    @property
    def verdict(self) -> str:
        """An effect, other parameters, no gap, no change, none of these, undecided, in a word."""
        return str(self.document["verdict"])

    @property
    def corrected_model(self) -> Path:
        """The model with what was found added: ``model=diagnosis`` takes it anywhere."""
        return self.file_for("model")

    @cached_property
    def causes(self) -> pandas.DataFrame:
        """What may cause the gap, with its probability; the likeliest first."""
        causes = self.document["causes"]
        columns = {
            "cause": [", ".join(cause["effects"]) or "none of these" for cause in causes],
            "probability": [cause["probability"] for cause in causes],
        }
        return frame_of(columns, {})

    @property
    def headline(self) -> str:
        """The answer."""
        return self.sentence

    def _findings(self) -> Findings:
        import msgspec

        from trms_cli.gap.diagnosis import DiagnosisResult as Answer
        from trms_cli.gap.findings import findings

        return findings(msgspec.convert(self.document, Answer))


class Excitation(StudyResult):
    """Commands that show a rig's dynamics."""

    DOCUMENT = "excitation.json"
    FILES: ClassVar[Mapping[str, str]] = {"controller": "excitation.csv", "file": "excitation.csv"}

    @property
    def file(self) -> Path:
        """The commands as CSV."""
        return self.file_for("file")

    @cached_property
    def commands(self) -> pandas.DataFrame:
        """The commands as a frame: the time in s as index, units in ``.attrs["units"]``."""
        table = load_pandas().read_csv(self.file, comment="#", index_col=0)
        units = {name.partition("[")[0]: name.partition("[")[2].rstrip("]") for name in table}
        table.columns = list(units)
        table.index.name = "time [s]"
        table.attrs["units"] = units
        return table

    @property
    def headline(self) -> str:
        """Kind, model and length."""
        d = self.document
        return f"{d['kind']} for {d['model']}, {d['duration_s']:g} s"

    def _findings(self) -> Findings:
        from trms_cli.identification.excitation.findings import findings

        return findings(self.document)


#: A recording, or several: files, folders of runs, or runs.
Recordings = Paths
_R = TypeVar("_R", bound=Result)


def identify(
    *overrides: str,
    real: Recordings | None = None,
    model: Any = None,
    free: str | Sequence[str] | None = None,
    effect: Any = None,
    method: Any = None,
    data: Mapping[str, Any] | None = None,
    validation: Mapping[str, Any] | None = None,
    picture: bool | None = None,
    out: str | PathLike[str] | None = None,
    config_dir: Paths = (),
    verbose: bool = False,
    **keys: Any,
) -> Fit:
    """Fit a model's parameters, or a network, to recordings: ``trms identify``.

    Parameters
    ----------
    *overrides : str
        ``"KEY=VALUE"`` as on the command line.
    real : path, run, or several
        Recordings of one rig: CSV, MAT, MCAP, a run's folder, a :class:`Run`.
    model : str, path or result
        What is fitted; its values are the start.
    free : str or sequence of str
        Parameters: names, patterns, ``"priors"``, ``"!NAME"`` for all but one.
    effect, method, data, validation : str, sequence or mapping
        As on the command line; mappings set keys: ``validation={"share": 0.3}``.
    picture : bool
        Whether to draw the figures and write the page.
    out, config_dir, verbose
        As for :func:`trms_cli.run`.
    **keys
        Any other key: ``seed=1``, ``windows={"length": 5}``, ``priors={…}``.

    Returns
    -------
    Fit
        ``.parameters`` as a frame, ``.model`` (a path), ``.document``, ``.report``.

    Raises
    ------
    TrmsError
        For what cannot be fitted.
    KeyboardInterrupt
        If it was stopped; the best so far is written, and the message tells where.

    Examples
    --------
    >>> fit = identify(real="monday.csv", free=["k_fvp", "k_ov"])
    >>> run(model=fit, controller="newton_mpc")
    """
    from trms_cli.library.tasks.identify import perform as task

    keywords = dict(
        real=real,
        model=model,
        free=free,
        effect=effect,
        method=method,
        data=data,
        validation=validation,
        picture=picture,
        **keys,
    )
    arguments = arguments_of("identify", overrides, keywords, out=out, config_dir=config_dir)
    return _performed(Fit, "identify", arguments, task, verbose)


def validate(
    *overrides: str,
    real: Recordings | None = None,
    model: Any = None,
    effect: Any = None,
    horizons: Sequence[float] | None = None,
    data: Mapping[str, Any] | None = None,
    page: bool | None = None,
    out: str | PathLike[str] | None = None,
    config_dir: Paths = (),
    verbose: bool = False,
    **keys: Any,
) -> Validation:
    """Hold models against recordings that they were not fitted to: ``trms validate``.

    Parameters
    ----------
    *overrides : str
        ``"KEY=VALUE"`` as on the command line.
    real : path, run, or several
        Recordings of one rig.
    model : str, path, result, or a list of them
        Several are compared over the same windows.
    effect, data : str, sequence or mapping
        As on the command line.
    horizons : sequence of float
        Lengths of the free runs, s.
    page : bool
        Whether to write the page with tables and pictures.
    out, config_dir, verbose
        As for :func:`trms_cli.run`.
    **keys
        Any other key: ``windows={"stride": 0.25}``.

    Returns
    -------
    Validation
        ``.errors`` as a frame, ``.document``, ``.report``.

    Raises
    ------
    TrmsError
        For what cannot be validated.

    Examples
    --------
    >>> judged = validate(real="tuesday.csv", model=["newtonian", fit])
    >>> judged.errors.loc[("newtonian", "alpha_h"), 2.0]
    """
    from trms_cli.composition.composer import compose
    from trms_cli.library.tasks.validate import perform as task
    from trms_cli.library.tasks.validated_models import named_sets, one_of

    several = list(model) if isinstance(model, list | tuple) else None
    keywords = dict(real=real, effect=effect, horizons=horizons, data=data, page=page, **keys)
    keywords["model"] = None if several is not None else model
    arguments = arguments_of("validate", overrides, keywords, out=out, config_dir=config_dir)
    if several is None:
        arguments = Arguments(
            tuple(named_sets(arguments.words)), arguments.objects, arguments.config_dirs
        )
        return _performed(
            Validation, "validate", arguments, lambda one, listener: task([one], listener), verbose
        )
    names = [text_of(m, "model").strip('"') for m in several]
    whole = Arguments((*arguments.words, f"model=[{','.join(names)}]"), {}, arguments.config_dirs)

    def together(listener: Listener) -> Done:
        compositions = [compose(one_of(arguments.argv, name), "validate") for name in names]
        return task(compositions, listener, names)

    words = words_of("validate", whole)
    result = call_task("validate", words, together, {}, verbose=verbose)
    return Validation(result.folder, text=result.text)


def stability(
    study: Any = None,
    *overrides: str,
    model: Any = None,
    effect: Any = None,
    controller: Any = None,
    observer: Any = None,
    page: bool | None = None,
    out: str | PathLike[str] | None = None,
    config_dir: Paths = (),
    verbose: bool = False,
    **keys: Any,
) -> Stability:
    """Answer one question about a model, or about the loop around it: ``trms stability``.

    Parameters
    ----------
    study : str, mapping or object
        The question: ``"local"``, with keys ``{"local": {"at": {"alpha_v": 0.4}}}``.
    *overrides : str
        ``"KEY=VALUE"`` as on the command line.
    model, effect, controller, observer : str, mapping or object
        The subject; a controller closes the loop. Objects as for :func:`trms_cli.run`.
    page : bool
        Whether to write the page and the figures.
    out, config_dir, verbose
        As for :func:`trms_cli.run`.
    **keys
        Any other key: ``sim={"sample_time": 0.01}``.

    Returns
    -------
    Stability
        ``.lead`` (the answer in sentences), ``.results``, ``.tables`` as frames, ``.report``.

    Raises
    ------
    TrmsError
        For a question that makes no sense for the subject; it says what is possible.

    Examples
    --------
    >>> modes = stability("local", model="rahideh")
    >>> stability("margins", controller="lqr", observer="ukf").lead
    """
    from trms_cli.library.tasks.stability import perform as task

    if isinstance(study, str) and "=" in study:  # an override, with the usual question
        study, overrides = None, (study, *overrides)
    keywords = dict(
        study=study,
        model=model,
        effect=effect,
        controller=controller,
        observer=observer,
        page=page,
        **keys,
    )
    arguments = arguments_of("stability", overrides, keywords, out=out, config_dir=config_dir)
    return _performed(Stability, "stability", arguments, task, verbose)


def diagnose(
    *overrides: str,
    real: Recordings | None = None,
    model: Any = None,
    candidates: str | Sequence[str] | None = None,
    effort: str | None = None,
    effect: Any = None,
    data: Mapping[str, Any] | None = None,
    page: bool | None = None,
    out: str | PathLike[str] | None = None,
    config_dir: Paths = (),
    verbose: bool = False,
    **keys: Any,
) -> Diagnosis:
    """Tell where a model and a rig differ, which effect causes it: ``trms diagnose``.

    Parameters
    ----------
    *overrides : str
        ``"KEY=VALUE"`` as on the command line.
    real : path, run, or several
        Recordings of one rig.
    model : str, path or result
        What is believed.
    candidates : str or sequence of str
        Effects that may be the cause: names, patterns ``"yaw_*"``, ``"!NAME"``; by default all.
    effort : {"quick", "normal", "thorough"}
    effect, data : str, sequence or mapping
        As on the command line.
    page : bool
        Whether to write the report.
    out, config_dir, verbose
        As for :func:`trms_cli.run`.
    **keys
        Any other key: ``seed=1``, ``block=5.0``.

    Returns
    -------
    Diagnosis
        ``.sentence``, ``.causes`` as a frame, ``.corrected_model``, ``.report``, ``.document``.

    Raises
    ------
    TrmsError
        For what cannot be diagnosed.
    KeyboardInterrupt
        If it was stopped; finished fits are kept.

    Examples
    --------
    >>> diagnosis = diagnose(real=rig, model="newtonian")
    >>> print(diagnosis.sentence)
    >>> run(model=diagnosis, controller="newton_mpc")
    """
    from trms_cli.library.tasks.diagnose import perform as task

    keywords = dict(
        real=real,
        model=model,
        candidates=candidates,
        effort=effort,
        effect=effect,
        data=data,
        page=page,
        **keys,
    )
    arguments = arguments_of("diagnose", overrides, keywords, out=out, config_dir=config_dir)
    return _performed(Diagnosis, "diagnose", arguments, task, verbose)


def excite(
    *overrides: str,
    excitation: Any = None,
    model: Any = None,
    duration: float | None = None,
    picture: bool | None = None,
    out: str | PathLike[str] | None = None,
    config_dir: Paths = (),
    verbose: bool = False,
    **keys: Any,
) -> Excitation:
    """Design commands that show a rig's dynamics within its bounds: ``trms excite``.

    Parameters
    ----------
    *overrides : str
        ``"KEY=VALUE"`` as on the command line.
    excitation : str or mapping
        Kind: ``"multisine"``, ``"prbs"``, ``"multilevel"``, ``"chirp"``.
    model : str, path or result
        What band and amplitude are designed with.
    duration : float
        s
    picture : bool
        Whether to draw spectra and ranges.
    out, config_dir, verbose
        As for :func:`trms_cli.run`.
    **keys
        Any other key: ``bounds={"alpha_v": 0.5}`` in rad, ``band={"highest": 1.0}`` in Hz.

    Returns
    -------
    Excitation
        ``.commands`` as a frame, ``.file`` (CSV), ``.document``.

    Raises
    ------
    TrmsError
        For what cannot be designed.

    Examples
    --------
    >>> excited = excite(duration=60)
    >>> run(controller={"played": {"u_v": {"file": excited}}})
    """
    from trms_cli.library.tasks.excite import perform as task

    keywords = dict(excitation=excitation, model=model, duration=duration, picture=picture, **keys)
    arguments = arguments_of("excite", overrides, keywords, out=out, config_dir=config_dir)
    return _performed(Excitation, "excite", arguments, task, verbose)


def _performed(
    kind: type[_R], command: str, arguments: Arguments, task: Callable[..., Done], verbose: bool
) -> _R:
    result = call_command(command, arguments, task, verbose=verbose)
    return kind(result.folder, text=result.text)
