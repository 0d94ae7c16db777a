"""Closing the loop from Python: :func:`run`, and a run once more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

from trms_cli.composition.arguments import Arguments, arguments_of, path_of
from trms_cli.core.errors import ConfigurationError
from trms_cli.library.calling import called, finished, perform, words_of
from trms_cli.library.run_result import Run, run_in

if TYPE_CHECKING:
    from trms_cli.composition.composer import Composition, Outcome
    from trms_cli.simulation.closed_loop import Experiment

#: A path, or several.
Paths = str | PathLike[str] | Sequence[str | PathLike[str]]


def run(
    *overrides: str | Experiment,
    controller: Any = None,
    ref: Any = None,
    model: Any = None,
    plant: Any = None,
    observer: Any = None,
    effect: Any = None,
    fault: Any = None,
    supervisor: Any = None,
    experiment: str | None = None,
    sim: Mapping[str, Any] | None = None,
    seed: int | None = None,
    picture: bool | None = None,
    out: str | PathLike[str] | None = None,
    config_dir: Paths = (),
    verbose: bool = False,
    **keys: Any,
) -> Run:
    """Close the loop once: what ``trms run`` does, with its log, score and picture.

    Each part is an option's name (:func:`trms_cli.options` lists them), a mapping, or an object
    of your own that keeps the part's protocol. What is not given is as on the command line.

    Parameters
    ----------
    *overrides : str, or Experiment
        ``"KEY=VALUE"`` as on the command line; or one `Experiment`, all of whose parts are
        objects.
    controller, ref, model, plant, observer, supervisor : str, mapping or object
        A name: ``"lqr"``. Keys of the one that is chosen: ``{"alpha_h": {"amplitude": 0.3}}``. A
        name with keys: ``{"sine": {"alpha_h": {"amplitude": 0.3}}}``. An object, whole or for a
        part: ``MyController(gain=2.0)``, ``{"alpha_h": lambda t: 0.3 * np.sin(t)}``. For `model`
        also a path, or what :func:`identify` or :func:`diagnose` gave back.
    effect, fault : str, sequence or mapping
        Several at once: ``["main_input_delay"]``, or with sizes
        ``{"yaw_coulomb_friction": {"torque": 0.01}}``.
    experiment : str
        A whole scenario by its name.
    sim : mapping
        ``duration`` and ``sample_time`` in s.
    seed : int
        Of noise and of draws from priors.
    picture : bool
        Whether to draw ``run.png``; :meth:`Run.figure` draws at any time.
    out : path
        The folder to write into, new or empty; by default ``outputs/<date>/<time>-run``.
    config_dir : path or sequence of paths
        Folders with option files of your own.
    verbose : bool
        Print what the command prints.
    **keys
        Any other key of the configuration: ``**{"signal@ref.alpha_v": "sawtooth"}``.

    Returns
    -------
    Run
        ``.score``, ``.log``, ``.folder``, ``["/estimate"]`` as a frame, ``.figure()``,
        ``.again(…)``.

    Raises
    ------
    TrmsError
        For what cannot be done: its ``problem``, ``where`` and ``remedy`` are what the command
        prints.
    KeyboardInterrupt
        If it was stopped; the log up to there is kept, and the message tells where.

    Examples
    --------
    >>> from trms_cli import run
    >>> lqr = run(controller="lqr", ref="sine", sim={"duration": 20})
    >>> lqr.score["channels"]["alpha_h"]["rmse"]
    >>> run("ref.alpha_h.amplitude=0.3", controller=MyController(gain=2.0))
    """
    given = dict(
        controller=controller, ref=ref, model=model, plant=plant, observer=observer,
        effect=effect, fault=fault, supervisor=supervisor, experiment=experiment, sim=sim,
        seed=seed, picture=picture, **keys,
    )  # fmt: skip
    typed, given = _with_experiment(overrides, given)
    return run_as(arguments_of("run", typed, given, out=out, config_dir=config_dir), verbose)


def run_as(asked: Arguments, verbose: bool) -> Run:
    """Run what the arguments of a call ask for."""
    from trms_cli.commands.run import perform as task

    folder, text = perform("run", asked, task, verbose=verbose)
    return Run(folder, folder / "run.mcap", text=text, asked=asked)


def run_again(
    run: Run,
    typed: Sequence[str],
    changes: Mapping[str, Any],
    *,
    out: str | PathLike[str] | None,
    verbose: bool,
) -> Run:
    """A run again, with changes; from its log, or where it had objects from its own arguments."""
    folders = changes.get("config_dir", ())
    rest = {key: value for key, value in changes.items() if key != "config_dir"}
    more = arguments_of("run", typed, rest, out=out, config_dir=folders)
    if run.asked is not None and (run.asked.objects or more.objects):
        mine = tuple(word for word in run.asked.words if not word.startswith("out="))
        before = Arguments(mine, run.asked.objects, run.asked.config_dirs)
        return run_as(before.with_more(more), verbose)
    return _repeated(run, more, verbose)


def _repeated(run: Run, more: Arguments, verbose: bool) -> Run:
    """What ``trms run --from LOG`` does."""
    from trms_cli.commands.run import perform as task
    from trms_cli.commands.run_repeat import repeat
    from trms_cli.composition.given_object import with_objects

    done: list[Outcome] = []

    def kept(composition: Composition) -> Outcome:
        done.append(task(with_objects(composition, more.objects)))
        return done[-1]

    words = words_of("run", Arguments(("--from", str(run.log), *more.argv)))
    with called(words, list(more.objects.values()), verbose=verbose) as heard:
        repeat(run.log, more.argv, "run", kept)
    folder, text = finished(done[0], heard, verbose=verbose)
    return Run(folder, folder / "run.mcap", text=text)


def _with_experiment(
    overrides: Sequence[Any], given: dict[str, Any]
) -> tuple[list[str], dict[str, Any]]:
    """The parts of an `Experiment` among the overrides, as if each had been given by its name."""
    typed = [word for word in overrides if isinstance(word, str)]
    others = [word for word in overrides if not isinstance(word, str)]
    if not others:
        return typed, given
    from trms_cli.simulation.closed_loop import Experiment

    if len(others) > 1 or not isinstance(others[0], Experiment):
        raise ConfigurationError(
            f"{others[0]!r} given",
            where="the arguments",
            remedy='overrides are text: "sim.duration=20"; an object goes to its part: '
            "controller=…",
        )
    whole: Experiment = others[0]
    parts = {
        "controller": whole.controller, "ref": whole.reference, "model": whole.model,
        "plant": whole.plant, "observer": whole.observer, "supervisor": whole.supervisor,
    }  # fmt: skip
    twice = [key for key in (*parts, "effect", "fault", "sim") if given[key] is not None]
    if twice:
        raise ConfigurationError(
            f"{twice[0]} is given, and an experiment that has one",
            where=twice[0],
            remedy="dataclasses.replace(experiment, …) changes an experiment",
        )
    sim = {
        "duration": whole.duration,
        "sample_time": whole.sample_time,
        "prediction_every": whole.prediction_every,
    }
    seed = whole.seed if given["seed"] is None else given["seed"]
    return typed, {**given, **parts, "sim": sim, "seed": seed}


def read_log(path: str | PathLike[str]) -> Run:
    """A run from its log, or from the folder that it wrote into; complete or not.

    Parameters
    ----------
    path : path
        ``run.mcap``, or its folder.

    Returns
    -------
    Run

    Raises
    ------
    RecordingError
        If there is no log that can be read.

    Examples
    --------
    >>> old = read_log("outputs/2025-01-31/12-00-00-run")
    >>> old["/command"].plot()
    """
    found = run_in(path_of(path, "path"))
    _ = found.logged  # a file that is no log is told here, not at the first question
    return found
