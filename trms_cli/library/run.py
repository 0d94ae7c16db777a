"""Closing the loop from Python: :func:`run`, what it leaves (:class:`Run`), and a run once more."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from trms_cli.composition.arguments import Arguments, arguments_of, path_of
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.findings import Findings, Section
from trms_cli.core.wording import named_files
from trms_cli.library import html
from trms_cli.library.call import call_command, call_task, words_of
from trms_cli.library.result import Paths, Result, frame_of

if TYPE_CHECKING:
    import pandas  # type: ignore[import-untyped,unused-ignore]

    from trms_cli.library.tasks.task import Done, Listener
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.reporting.style import NotebookFigure
    from trms_cli.simulation.closed_loop import Experiment

#: Pixels of the picture in a notebook.
_WIDTH = 640


@dataclass(frozen=True, repr=False, eq=False)
class Run(Result):
    """A run of the loop, from its log.

    ``run["/estimate"]`` is a pandas frame of one topic: a row a sample, the time in s as index,
    units in ``.attrs["units"]``. ``run.topics`` tells which there are.
    """

    log: Path  #: The MCAP log; all that follows comes from it
    #: What it was asked for by, where it was run from Python just now
    arguments: Arguments | None = field(default=None, kw_only=True)

    FILES: ClassVar[Mapping[str, str]] = {"real": ".", "file": "."}

    def file_for(self, key: str) -> Path:
        """The log, for what asks for a recording."""
        return self.log if key in ("real", "plant", "validation") else super().file_for(key)

    @cached_property
    def logged(self) -> LoggedRun:
        """The log as it was read: tables of arrays by topic, records, attachments."""
        from trms_cli.recordings.log_reader import read_log

        return read_log(self.log)

    @cached_property
    def score(self) -> dict[str, Any]:
        """``trms.score/1``: ``score["channels"]["alpha_h"]["rmse"]``, in SI units."""
        from trms_cli.scoring.score import score_log

        return dict(self.logged.score) or score_log(self.logged)

    @property
    def document(self) -> dict[str, Any]:
        """The score: what ``trms score --json`` prints."""
        return self.score

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, every key with its value."""
        from trms_cli.core.yaml_data import load_yaml

        return dict(load_yaml(self.logged.config) or {})

    @property
    def choices(self) -> dict[str, Any]:
        """The option chosen in each group; an object by its class."""
        return dict(json.loads(self.logged.run.get("choices", "{}")))

    @property
    def outcome(self) -> str:
        """``completed``, ``interrupted``, ``failed`` or ``died``."""
        return self.logged.outcome

    @property
    def topics(self) -> list[str]:
        """Topics that the log has samples of."""
        return [name for name, samples in self.logged.tables.items() if len(samples)]

    def __getitem__(self, topic: str) -> pandas.DataFrame:
        """One topic as a frame: the time in s as index, units in ``.attrs["units"]``.

        Raises
        ------
        RecordingError
            If the log has no such topic; it names those there are.
        """
        samples = self.logged.table(topic if topic.startswith("/") else f"/{topic}")
        return frame_of(samples.columns, samples.units, samples.time, "time [s]")

    def __contains__(self, topic: object) -> bool:
        return topic in self.topics or f"/{topic}" in self.topics

    def __iter__(self) -> Any:
        return iter(self.topics)

    def _ipython_key_completions_(self) -> list[str]:
        return self.topics

    def figure(self) -> NotebookFigure:
        """The picture of the run, to be changed or saved: ``run.figure().savefig("run.pdf")``."""
        from trms_cli.reporting.run_picture import figure_of_run
        from trms_cli.scoring.score import limits_of

        limits = limits_of(self.logged)
        return figure_of_run(self.logged.tables, self.score, title=self.headline, limits=limits)

    def again(
        self,
        *overrides: str,
        out: str | PathLike[str] | None = None,
        verbose: bool = False,
        **changes: Any,
    ) -> Run:
        """The same run, but for what is given; the arguments are those of :func:`trms_cli.run`.

        It is made from its log, or where it had objects from its own arguments.

        Examples
        --------
        >>> lqr = run(controller="lqr", seed=3)
        >>> pid = lqr.again(controller="pid")    # the same reference, rig and noise
        """
        folders = changes.pop("config_dir", ())
        more = arguments_of("run", overrides, changes, out=out, config_dir=folders)
        if self.arguments is not None and (self.arguments.objects or more.objects):
            mine = tuple(word for word in self.arguments.words if not word.startswith("out="))
            before = Arguments(mine, self.arguments.objects, self.arguments.config_dirs)
            return run_as(_with_its_rig(before, more).with_more(more), verbose)
        return _repeated(self, more, verbose)

    @property
    def headline(self) -> str:
        """Who ran, on what, for how long."""
        choices = named_files(self.choices, self.logged.config)
        if not choices:
            return str(self.log)
        words = [str(choices.get("controller")), f"ref {choices.get('ref')}"]
        words += [f"{g} {choices.get(g)}" for g in ("model", "observer", "plant")]
        words += [f"{g} {', '.join(choices[g])}" for g in ("effect", "fault") if choices.get(g)]
        return " · ".join(words)

    def __repr__(self) -> str:
        errors = [
            f"{name} RMSE {_three(c['rmse'])} {c['unit']}"
            for name, c in self.score["channels"].items()
        ]
        ended = [] if self.outcome == "completed" else [self.outcome]
        return f"<Run {' | '.join([self.headline, *ended, *errors, str(self.log)])}>"

    @property
    def findings(self) -> Findings:
        """What is worth telling of it, as its page has it."""
        from trms_cli.scoring.findings import answer, measures_of, tables_of, warnings_of

        who = str(self.choices.get("controller") or "The run")
        problems = [f"**{self.outcome}**: {'; '.join(self.logged.problems)}"]
        return Findings(
            self.headline,
            [answer(self.score, who), *(problems if self.outcome != "completed" else [])],
            [Section("Score", blocks=tables_of(self.score), folded=True)],
            measures=measures_of(self.score),
            warnings=warnings_of(self.score),
        )

    def _repr_html_(self) -> str:
        return html.view(self.findings, [self._small_picture()], {"log": self.log})

    def _small_picture(self) -> bytes:
        picture = self.pictures.get("run")
        if picture is None:
            return self.figure()._repr_png_()
        from trms_cli.reporting.style import small_png

        return small_png(picture.read_bytes(), width=_WIDTH)


def _three(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def run_in(path: Path) -> Run:
    """The run of a log, or of a run's folder; raises RecordingError if there is none."""
    from trms_cli.runs.run_folder import log_of

    log = log_of(path)
    if not log.is_file():
        raise RecordingError(
            "there is no log of a run",
            where=str(path),
            remedy="name a run.mcap, or the folder that a run wrote into",
        )
    return Run(log.parent, log)


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
    gap_watch: Any = None,
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
    controller, ref, model, plant, observer, supervisor, gap_watch : str, mapping or object
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
    keywords = dict(
        controller=controller,
        ref=ref,
        model=model,
        plant=plant,
        observer=observer,
        effect=effect,
        fault=fault,
        supervisor=supervisor,
        gap_watch=gap_watch,
        experiment=experiment,
        sim=sim,
        seed=seed,
        picture=picture,
        **keys,
    )
    typed, keywords = _with_experiment(overrides, keywords)
    return run_as(arguments_of("run", typed, keywords, out=out, config_dir=config_dir), verbose)


def run_as(arguments: Arguments, verbose: bool) -> Run:
    """Run what the arguments of a call ask for."""
    from trms_cli.library.tasks.run import perform

    return _run_of(call_command("run", arguments, perform, verbose=verbose), arguments)


#: Typed in the place of a model that is an object, to see what stays of a run under another model.
_OBJECT = ["model=newtonian"]


def _run_of(result: Done, arguments: Arguments | None = None) -> Run:
    return Run(result.folder, result.folder / "run.mcap", text=result.text, arguments=arguments)


def _with_its_rig(before: Arguments, more: Arguments) -> Arguments:
    """The arguments of a run with its rig chosen, where `more` gives another model.

    As of ``trms run --from LOG`` (:mod:`trms_cli.composition.on_top`), for a run with objects.
    """
    from trms_cli.composition.composer import compose
    from trms_cli.composition.on_top import RIG, RIG_CHOICE, on_top

    places = {word.lstrip("+").partition("=")[0] for word in (*before.words, *more.words)}
    given = {*before.objects, *more.objects}
    if RIG_CHOICE in places or {"plant", RIG} & given:
        return before
    typed = [*more.words, *_OBJECT[: "model" in more.objects]]
    if "model" in before.objects:
        if not any(re.match(r"model\b", word) for word in typed):
            return before
        return replace(before, objects={**before.objects, RIG: before.objects["model"]})
    earlier = compose(before.argv, "run")
    rig = on_top(earlier, before.words, typed, "run", played=False).rig
    return replace(before, words=(*before.words, *rig))


def _repeated(run: Run, more: Arguments, verbose: bool) -> Run:
    """What ``trms run --from LOG`` does."""
    from trms_cli.composition.composer import Composition, compose
    from trms_cli.composition.given_object import with_objects
    from trms_cli.library.tasks.repeat import repetition
    from trms_cli.library.tasks.run import perform

    def again(listener: Listener) -> Done:
        request = repetition(run.log, [*more.argv, *_OBJECT[: "model" in more.objects]], "run")
        if isinstance(request, list) and "model" in more.objects:
            del request[-1]
        composition = request if isinstance(request, Composition) else compose(request, "run")
        return perform(with_objects(composition, more.objects), listener)

    words = words_of("run", Arguments(("--from", str(run.log), *more.argv)))
    return _run_of(call_task("run", words, again, more.objects, verbose=verbose))


def _with_experiment(
    overrides: Sequence[Any], keywords: dict[str, Any]
) -> tuple[list[str], dict[str, Any]]:
    """The parts of an `Experiment` among the overrides, as if each had been given by its name."""
    typed = [word for word in overrides if isinstance(word, str)]
    others = [word for word in overrides if not isinstance(word, str)]
    if not others:
        return typed, keywords
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
        "controller": whole.controller,
        "ref": whole.reference,
        "model": whole.model,
        "plant": whole.plant,
        "observer": whole.observer,
        "supervisor": whole.supervisor,
        "gap_watch": whole.gap_watch,
    }
    twice = [key for key in (*parts, "effect", "fault", "sim") if keywords[key] is not None]
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
    seed = whole.seed if keywords["seed"] is None else keywords["seed"]
    return typed, {**keywords, **parts, "sim": sim, "seed": seed}


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
    result = run_in(path_of(path, "path"))
    _ = result.logged  # a file that is no log is told here, not at the first question
    return result
