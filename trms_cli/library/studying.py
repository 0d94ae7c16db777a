"""The studies of rigs and models from Python: fitted, validated, diagnosed, excited."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any, TypeVar

from trms_cli.composition.arguments import Arguments, arguments_of, text_of
from trms_cli.library.calling import done, done_by, words_of
from trms_cli.library.findings import Diagnosis, Excitation, Fit, Stability, Validation
from trms_cli.library.result import Result
from trms_cli.library.tasks.task import Done, Listener

#: A path, or several.
Paths = str | PathLike[str] | Sequence[str | PathLike[str]]
#: A recording, or several: files, folders of runs, or runs.
Recordings = str | PathLike[str] | Sequence[str | PathLike[str]]
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

    given = dict(
        real=real, model=model, free=free, effect=effect, method=method, data=data,
        validation=validation, picture=picture, **keys,
    )  # fmt: skip
    asked = arguments_of("identify", overrides, given, out=out, config_dir=config_dir)
    return _performed(Fit, "identify", asked, task, verbose)


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
    given = dict(real=real, effect=effect, horizons=horizons, data=data, page=page, **keys)
    given["model"] = None if several is not None else model
    asked = arguments_of("validate", overrides, given, out=out, config_dir=config_dir)
    if several is None:
        asked = Arguments(tuple(named_sets(asked.words)), asked.objects, asked.config_dirs)
        return _performed(
            Validation, "validate", asked, lambda one, listener: task([one], listener), verbose
        )
    names = [text_of(m, "model").strip('"') for m in several]
    whole = Arguments((*asked.words, f"model=[{','.join(names)}]"), {}, asked.config_dirs)

    def together(listener: Listener) -> Done:
        compositions = [compose(one_of(asked.argv, name), "validate") for name in names]
        return task(compositions, listener, names)

    words = words_of("validate", whole)
    result = done_by("validate", words, together, {}, verbose=verbose)
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
    given = dict(
        study=study, model=model, effect=effect, controller=controller, observer=observer,
        page=page, **keys,
    )  # fmt: skip
    asked = arguments_of("stability", overrides, given, out=out, config_dir=config_dir)
    return _performed(Stability, "stability", asked, task, verbose)


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
        Suspected effects: names, patterns ``"yaw_*"``, ``"!NAME"``; by default all.
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
        If it was stopped; finished stages are kept.

    Examples
    --------
    >>> diagnosis = diagnose(real=rig, model="newtonian")
    >>> print(diagnosis.sentence)
    >>> run(model=diagnosis, controller="newton_mpc")
    """
    from trms_cli.library.tasks.diagnose import perform as task

    given = dict(
        real=real, model=model, candidates=candidates, effort=effort, effect=effect, data=data,
        page=page, **keys,
    )  # fmt: skip
    asked = arguments_of("diagnose", overrides, given, out=out, config_dir=config_dir)
    return _performed(Diagnosis, "diagnose", asked, task, verbose)


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

    given = dict(excitation=excitation, model=model, duration=duration, picture=picture, **keys)
    asked = arguments_of("excite", overrides, given, out=out, config_dir=config_dir)
    return _performed(Excitation, "excite", asked, task, verbose)


def _performed(
    kind: type[_R], command: str, asked: Arguments, task: Callable[..., Done], verbose: bool
) -> _R:
    result = done(command, asked, task, verbose=verbose)
    return kind(result.folder, text=result.text)
