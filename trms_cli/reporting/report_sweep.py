"""What a page tells of many runs: who won, how figures spread and on what they depend, failures.

::

    findings_of_sweep(SweepReport(name="sweep", runs=[SweepRun(name="0", …), …], …))
"""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from trms_cli.core.chart import Axis, Boxes, Colour, Curve, Heat, Mark, Panel, Points, page_look
from trms_cli.core.findings import Cell, Column, Datum, Findings, Measure, Section, table
from trms_cli.reporting.page import MOST_ROWS
from trms_cli.reporting.report_runs import plot_section, ranking_section
from trms_cli.reporting.run_panels import histogram
from trms_cli.reporting.signals import FloatArray
from trms_cli.reporting.sweep_report import Draws, FailureShare, Objective, SweepReport, SweepRun
from trms_cli.scoring.comparison.ranking import Ranking

#: More entrants than this are not told apart by colour; their boxes still stand side by side.
_MOST_COLOURS, _MOST_BOXES = 8, 60
_MOST_KEYS, _MOST_CATEGORIES, _MOST_CELLS, _BINS = 8, 40, 60, 30
#: Runs that are drawn: more dots hide one another, and make a page that no browser opens.
_MOST_DRAWN = 5000
#: Runs of a box that are drawn as dots too.
_MOST_DOTS = 300
#: Entrants that are told apart by rings around one another.
_MOST_RINGS = 4
_OTHER = "all runs"
#: Each dot of a box has a place beside it by its number times this, modulo one (the golden ratio).
_SCATTER = 0.618
#: A whisker reaches this many times the distance of the quartiles at most.
_WHISKER = 1.5


def spread_panels(sweep: SweepReport, figures: Sequence[str]) -> list[Panel]:
    """Boxes of a figure for each entrant, and a histogram; the reader chooses the figure."""
    if not figures:
        return []
    entrants, groups = _groups(sweep, _MOST_BOXES), _groups(sweep, 4)
    few = max((len(runs) for _, runs in entrants), default=0) <= _MOST_DOTS
    colours = [_colour(i if len(entrants) <= _MOST_COLOURS else 0) for i in range(len(entrants))]
    who = Axis("", categories=[name for name, _ in entrants])
    caption = "Box: quartiles and median." + (" A dot is a run." if few else "")

    def boxes(figure: str) -> Panel:
        quantiles = [_quartiles(_numbers(runs, figure)) for _, runs in entrants]
        marks: list[Mark] = [Boxes(range(len(entrants)), quantiles, colours=colours)]
        for place, (_, runs) in enumerate(entrants):
            low, high = quantiles[place][0], quantiles[place][-1]
            dots = [
                (i, value, run.name)
                for i, (run, value) in enumerate(zip(runs, _numbers(runs, figure), strict=True))
                if few or value < low or value > high
            ]
            beside = [place + 0.3 * (i * _SCATTER % 1.0 - 0.5) for i, _, _ in dots]
            marks.append(
                Points(
                    [value for _, value, _ in dots],
                    beside,
                    colour=colours[place],
                    size=3,
                    tooltips=[name for _, _, name in dots],
                    opacity=0.55,
                )
            )
        height = (90 + 34 * len(entrants)) / 256
        return Panel(
            Axis(sweep.title(figure)), who, marks, "by who ran", caption=caption, row_height=height
        )

    def counts(figure: str) -> Panel:
        values = [np.array(_numbers(runs, figure)) for _, runs in groups]
        all_values = np.concatenate([[], *values])
        all_values = all_values[np.isfinite(all_values)]
        low, high = (all_values.min(), all_values.max()) if len(all_values) else (0.0, 1.0)
        edges = np.linspace(low, high if high > low else low + 1e-9, _BINS + 1)
        several = len(groups) > 1
        marks = [
            histogram(
                own,
                edges,
                name if several else "",
                _colour(number),
                opacity=0.6 if several else 0.9,
            )
            for number, ((name, _), own) in enumerate(zip(groups, values, strict=True))
        ]
        return Panel(Axis(sweep.title(figure)), Axis("runs"), marks, "distribution")

    return [_variant_panel(sweep, figures, boxes), _variant_panel(sweep, figures, counts)]


def key_panels(sweep: SweepReport, figures: Sequence[str]) -> list[Panel]:
    """A figure against each key that was varied: dots over numbers, boxes over options."""
    if not figures:
        return []
    numeric, number_keys = sweep.numeric_keys, _numeric(sweep)
    others = [
        key
        for key in sweep.keys
        if key not in numeric
        and not sweep.names_entrants(key)  # their spread is drawn already
        and 1 < _distinct(sweep, key) <= _MOST_CATEGORIES
    ]
    panels = [
        _variant_panel(sweep, figures, partial(_scatter, sweep, key))
        for key in number_keys[:_MOST_KEYS]
    ]
    for key in others[:_MOST_KEYS]:
        panels.append(_variant_panel(sweep, figures, partial(_categories, sweep, key)))
    if len(number_keys) >= 2:
        panels.append(
            _variant_panel(sweep, figures, partial(_map, sweep, number_keys[0], number_keys[1]))
        )
    return panels


def chosen_words(sweep: SweepReport) -> str:
    """Which of many varied keys are drawn, as a sentence; "" where all are."""
    count = len(_numeric(sweep))
    if count <= _MOST_KEYS:
        return ""
    by = "the first in the order in which they were typed"
    if sweep.draws and sweep.draws.correlations:
        by = "those with the largest rank correlation with a figure, whatever its sign"
    return (
        f" Of {count} values that were varied {_MOST_KEYS} are here: {by}. The others stand in the "
        "table of all runs."
    )


def _numeric(sweep: SweepReport) -> list[str]:
    """Numbers that were varied; seeds, which have no order, only where there is nothing else."""
    varied = [key for key in sweep.numeric_keys if _distinct(sweep, key) > 1]
    return [key for key in varied if not key.endswith("seed")] or varied


def pareto_panels(sweep: SweepReport) -> list[Panel]:
    """Each pair of objectives: all runs, and those that nothing beats."""
    pairs = list(itertools.combinations(sweep.objectives, 2))[:6]
    front = sweep.front()
    panels = [_pareto(sweep, front, one, other, len(pairs) > 1) for one, other in pairs]
    return panels + _history(sweep)


def _history(sweep: SweepReport) -> list[Panel]:
    """The best so far over the trials: whether more of them would have helped."""
    if sum(value is not None for value in sweep.history) < 2:
        return []
    several = len(sweep.objectives) > 1
    words = "volume dominated by the front" if several else sweep.title(sweep.objectives[0].figure)
    values = [math.nan if value is None else float(value) for value in sweep.history]
    curve = Curve(range(1, len(values) + 1), values, is_step=True)
    return [Panel(Axis("trials"), Axis(words), [curve], "the best so far")]


def _pareto(
    sweep: SweepReport, front: Sequence[SweepRun], one: Objective, other: Objective, half: bool
) -> Panel:
    both = {one.figure, other.figure}
    candidates = [run for run in sweep.candidates if not run.failed and both <= set(run.figures)]
    best = sorted(
        (run for run in front if both <= set(run.figures)), key=lambda run: run.figures[one.figure]
    )

    def dots(
        runs: Sequence[SweepRun], label: str, colour: Colour, size: float, **more: Any
    ) -> Mark:
        x, y = (_numbers(runs, objective.figure) for objective in (one, other))
        names = [run.name for run in runs]
        return Points(x, y, label, colour=colour, size=size, tooltips=names, **more)

    # Between two runs of the front nothing is known to be had: steps, not a slope. With three
    # objectives the front is a surface, and a line over it would say nothing.
    steps = ("vh" if one.largest else "hv") if len(sweep.objectives) == 2 else ""
    marks = [
        dots(candidates, "trials" if sweep.trials else "runs", "grey", 4.5),
        dots(best, "Pareto front", "vermilion", 6.5, step_shape=steps),
    ]
    across, up = (
        Axis(f"{sweep.title(o.figure)}, {'largest' if o.largest else 'least'} sought")
        for o in (one, other)
    )
    caption = (
        "Of the runs on the front none is as good as another in all objectives and better in one."
    )
    return Panel(
        across,
        up,
        marks,
        f"{other.figure} against {one.figure}",
        caption=caption,
        half=half,
        row_height=1.55,
    )


def _scatter(sweep: SweepReport, key: str, figure: str) -> Panel:
    groups = _groups(sweep, _MOST_COLOURS)
    size = 5.0 if len(sweep.runs) <= 200 else 3.0
    marks = [
        Points(
            [_float(run.values.get(key)) for run in runs],
            _numbers(runs, figure),
            name if len(groups) > 1 else "",
            colour=_colour(number),
            size=size,
            opacity=0.7,
            tooltips=[run.name for run in runs],
        )
        for number, (name, runs) in enumerate(groups)
    ]
    across = Axis(key, log=_spans_decades([run.values.get(key) for run in sweep.runs]))
    return Panel(
        across, Axis(sweep.title(figure)), marks, f"against {key}", half=True, row_height=1.2
    )


def _categories(sweep: SweepReport, key: str, figure: str) -> Panel:
    groups = _groups(sweep, _MOST_COLOURS)
    words = list(dict.fromkeys(_word(run.values.get(key)) for _, runs in groups for run in runs))
    width = 0.8 / len(groups)
    marks = []
    for number, (name, runs) in enumerate(groups):
        own = [[r for r in runs if _word(r.values.get(key)) == word] for word in words]
        places = [place + width * (number - 0.5 * (len(groups) - 1)) for place in range(len(words))]
        quantiles = [_quartiles(_numbers(some, figure)) for some in own]
        label = name if len(groups) > 1 else ""
        marks.append(
            Boxes(places, quantiles, label, [_colour(number)], across=False, width=0.8 * width)
        )
    across = Axis(key, categories=words)
    return Panel(across, Axis(sweep.title(figure)), marks, f"by {key}", half=True, row_height=1.2)


def _map(sweep: SweepReport, across: str, up: str, figure: str) -> Panel:
    """A heat map of means where two keys make a grid, else dots coloured by the figure."""
    runs = [
        run
        for run in sweep.runs
        if not run.failed and run.values.get(across) is not None and run.values.get(up) is not None
    ]
    xs, ys = (sorted({_float(run.values[key]) for run in runs}) for key in (across, up))
    axes = (Axis(across), Axis(up))
    marks: Sequence[Mark]
    if max(len(xs), len(ys)) <= _MOST_CELLS and len(xs) * len(ys) <= 4 * len(runs):
        ys = ys[::-1]  # the largest on top
        axes = (
            Axis(across, categories=[f"{v:g}" for v in xs]),
            Axis(up, categories=[f"{v:g}" for v in ys]),
        )
        marks = [Heat(_cells(runs, across, up, xs, ys, figure))]
        caption = "Mean over the runs of a cell; empty where none ended well."
    else:
        marks, words = _rings(sweep, runs, across, up, figure)
        caption = f"Colour: the figure; dark is large.{words}"
    return Panel(
        *axes, marks, f"over {across} and {up}", caption=caption, half=True, row_height=1.55
    )


def _rings(
    sweep: SweepReport, runs: Sequence[SweepRun], across: str, up: str, figure: str
) -> tuple[list[Points], str]:
    """Entrants at equal draws as a dot and rings around it, so that all are seen; in words."""
    entrants = [name for name in sweep.entrants if any(run.entrant == name for run in runs)]
    ringed = 1 < len(entrants) <= _MOST_RINGS
    marks = []
    for place, entrant in enumerate(entrants if ringed else [""]):
        own = [run for run in runs if not ringed or run.entrant == entrant]
        x, y = ([_float(run.values[key]) for run in own] for key in (across, up))
        labels = [f"{run.name}, {entrant}" if ringed else run.name for run in own]
        marks.append(
            Points(
                x,
                y,
                marker="unstable" if place else "dot",
                size=5.7 + 4.3 * place,
                tooltips=labels,
                values=_numbers(own, figure),
            )
        )
    if not ringed:
        return marks, ""
    return marks, f" Dot: {entrants[0]}; rings, from the inside: {', '.join(entrants[1:])}."


def _cells(
    runs: Sequence[SweepRun], across: str, up: str, xs: list[float], ys: list[float], figure: str
) -> FloatArray:
    total, count = np.zeros((len(ys), len(xs))), np.zeros((len(ys), len(xs)))
    columns = {value: i for i, value in enumerate(xs)}
    rows = {value: i for i, value in enumerate(ys)}
    for run in runs:
        if figure in run.figures:
            place = rows[_float(run.values[up])], columns[_float(run.values[across])]
            total[place] += run.figures[figure]
            count[place] += 1
    with np.errstate(invalid="ignore"):
        return total / count


def _variant_panel(
    sweep: SweepReport, figures: Sequence[str], draw: Callable[[str], Panel]
) -> Panel:
    """A panel that shows the first figure, and any that the reader chooses."""
    panel = draw(figures[0])
    if len(figures) < 2:
        return panel
    others = {sweep.title(figure): draw(figure) for figure in figures}
    return replace(panel, variants=others)


def _quartiles(values: Sequence[float]) -> list[float]:
    """Whisker, quartile, median, quartile, whisker; NaN without a value."""
    finite_values = np.array(values, dtype=float)
    finite_values = finite_values[np.isfinite(finite_values)]
    if not len(finite_values):
        return [math.nan] * 5
    first, middle, third = np.quantile(finite_values, (0.25, 0.5, 0.75))
    reach = _WHISKER * (third - first)
    low = finite_values[finite_values >= first - reach].min()
    high = finite_values[finite_values <= third + reach].max()
    return [float(value) for value in (low, first, middle, third, high)]


def _colour(number: int) -> Colour:
    colour: Colour = page_look(number)["colour"]
    return colour


def _groups(sweep: SweepReport, most: int) -> list[tuple[str, list[SweepRun]]]:
    """Runs by entrant; all in one where there are more than can be told apart."""
    if len(sweep.entrants) > most:
        return [(_OTHER, [run for run in sweep.runs if not run.failed])]
    return [(name or _OTHER, sweep.of(name)) for name in sweep.entrants if sweep.of(name)]


def _numbers(runs: Sequence[SweepRun], figure: str) -> list[float]:
    return [float(run.figures.get(figure, math.nan)) for run in runs]


def _float(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _word(value: Any) -> str:
    return "–" if value in (None, "") else str(value)


def _distinct(sweep: SweepReport, key: str) -> int:
    return len({v for run in sweep.runs if (v := run.values.get(key)) not in (None, "")})


def _spans_decades(values: Sequence[Any]) -> bool:
    numbers = [float(v) for v in values if isinstance(v, (int, float))]
    return bool(numbers) and min(numbers) > 0 and max(numbers) / min(numbers) >= 100


_MOST_REASONS, _LONGEST_REASON = 50, 300
_MOST_OF_A_FRONT = 100
_MOST_NAMES = _MOST_NAMED = 6
#: Figures that the reader can choose for the plots.
_MOST_CHOICES = 14
_MOST_CORRELATIONS = 30
#: Of p values that are adjusted for their number.
_LEVEL = 0.05


def findings_of_sweep(
    sweep: SweepReport, *, ranking: Ranking | None = None, title: str = ""
) -> Findings:
    """What a page tells of many runs; `ranking`: as ``trms compare`` has it."""
    drawn = _drawn(sweep)
    figures = _telling(drawn)
    few = ""
    if len(drawn.runs) < len(sweep.runs):
        few = (
            f" Drawn are {len(drawn.runs)} of the {len(sweep.runs)} runs, evenly chosen; the "
            "ranking and the failures count all."
        )
    several = ranking is not None and len(ranking.standings) > 1
    varied = f"Each dot is a run; pointing at it tells which.{few}{chosen_words(sweep)}"
    sections = [
        _objectives(sweep),
        ranking_section(ranking if several else None),
        *(_draws(sweep.draws) if sweep.draws else ()),
        plot_section(
            "How figures spread", spread_panels(drawn, figures), f"Of the runs that ended.{few}"
        ),
        plot_section("What they depend on", key_panels(drawn, figures), varied),
        _failures(sweep),
        _all_runs(sweep),
    ]
    return Findings(
        title or f"Sweep {sweep.name}",
        _lead(sweep, ranking),
        [section for section in sections if section.blocks],
        measures=_measures(sweep, figures),
        facts=sweep.facts,
    )


def _measures(sweep: SweepReport, figures: Sequence[str]) -> list[Measure]:
    """How many runs there are and ended, and where the figure lies that says most."""
    completed = sum(run.outcome == "completed" for run in sweep.runs)
    total = max(sweep.planned_count or 0, len(sweep.runs))
    measures = [
        Measure("runs", total),
        Measure("completed", completed, "", "good" if completed == total else "doubtful"),
    ]
    if figures:
        name, unit = figures[0], sweep.figures.get(figures[0], "")
        values = np.array(
            [r.figures[name] for r in sweep.runs if name in r.figures and not r.failed]
        )
        values = values[np.isfinite(values)]
        if values.size:
            for label, value in zip(
                ("least", "median", "largest"), np.quantile(values, (0, 0.5, 1)), strict=True
            ):
                measures.append(Measure(f"{label} {name}", float(value), unit))
    return measures


def _drawn(sweep: SweepReport) -> SweepReport:
    """The sweep, or of a very large one as many runs as can be told apart in a picture."""
    step = math.ceil(len(sweep.runs) / _MOST_DRAWN)
    return sweep if step <= 1 else replace(sweep, runs=sweep.runs[::step])


def _telling(sweep: SweepReport) -> list[str]:
    """Figures that differ between runs, objectives first."""
    objective_figures = [objective.figure for objective in sweep.objectives]
    names = []
    for name in dict.fromkeys([*objective_figures, *sweep.figures]):
        values = [r.figures[name] for r in sweep.runs if not r.failed and name in r.figures]
        if len(set(values)) > 1 or (values and name in objective_figures):
            names.append(name)
    return names[:_MOST_CHOICES]


def _lead(sweep: SweepReport, ranking: Ranking | None) -> list[str]:
    outcomes = Counter(run.outcome for run in sweep.runs)
    completed = outcomes.pop("completed", 0)
    others = ", ".join(f"**{count} {outcome}**" for outcome, count in outcomes.most_common())
    total = max(sweep.planned_count or 0, len(sweep.runs))
    never = total - len(sweep.runs)
    if never:
        shortfall = f"**{never} not begun**: the sweep stopped before its end"
        others = f"{others}, {shortfall}" if others else shortfall
    sentences = [f"{completed} of {total} runs completed{'; ' + others if others else ''}."]
    if ranking is not None and len(ranking.ranked) > 1:
        first, second = ranking.ranked[:2]
        sentence = f"**{first.name}** tracks best"
        if second.against_first > 0:
            sentence += f"; {second.name} misses by {_times(second.against_first)}"
            if second.different is False:
                sentence += ", which these runs cannot tell from equal"
        sentences.append(sentence + ".")
    if sweep.draws:
        sentences += _failures_sentence(sweep.draws)
    best = _best(sweep)
    if best is not None:
        run, value, name = best
        sentences.append(
            f"{_kind(sweep).capitalize()} {run.name} has the least {name}, {value:.3g}"
            f"{_where(sweep, run)}."
        )
    return sentences


def _times(ratio: float) -> str:
    """How many times as much, with the digits that tell it from one."""
    if ratio == 1:
        return "as much"
    digits = next((d for d in range(3, 7) if f"{ratio:.{d}g}" != "1"), 0)
    return f"{ratio:.{digits}g} times as much" if digits else "as much, to six digits"


def _best(sweep: SweepReport) -> tuple[SweepRun, float, str] | None:
    name = next((o.figure for o in sweep.objectives if not o.largest), None) or next(
        (n for n in sweep.figures if n.startswith("rmse")), None
    )
    if name is None:
        return None
    # A run that ended early has had less time to err.
    candidates = [r for r in sweep.candidates if r.outcome == "completed" and name in r.figures]
    if not candidates:
        return None
    run = min(candidates, key=lambda each: each.figures[name])
    return run, run.figures[name], sweep.title(name)


def _where(sweep: SweepReport, run: SweepRun) -> str:
    filled_keys = [key for key in sweep.keys if run.values.get(key) not in (None, "")]
    setting_keys = [key for key in filled_keys if key not in sweep.drawn_keys]
    parts = [f"{key} {_value_text(run.values[key])}" for key in setting_keys[:_MOST_NAMED]]
    if len(setting_keys) > _MOST_NAMED:
        parts.append(f"and {len(setting_keys) - _MOST_NAMED} more")
    if len(filled_keys) > len(setting_keys):
        parts.append(f"{len(filled_keys) - len(setting_keys)} drawn values")
    return f" ({', '.join(parts)})" if parts else ""


def _objectives(sweep: SweepReport) -> Section:
    if not sweep.objectives:
        return Section("Objectives")
    front = sweep.front()
    names = [objective.figure for objective in sweep.objectives]
    sought = [f"the {'largest' if o.largest else 'least'} {o.figure}" for o in sweep.objectives]
    words = f"Sought: {', '.join(sought)}."
    section = plot_section("Objectives", pareto_panels(sweep), words)
    front.sort(key=lambda run: run.figures.get(names[0], math.inf))
    keys = [key for key in sweep.keys if any(run.values.get(key) is not None for run in front)]
    kind = _kind(sweep)
    columns = [Column(kind, "name"), *(Column(sweep.title(n), _figure(n)) for n in names)]
    columns += [Column(key, _value(key)) for key in keys]
    what = f"Each {kind} that none beats in all objectives." if len(names) > 1 else "The best."
    best = table(front[:_MOST_OF_A_FRONT], columns, what)
    return Section("Objectives", section.text, [*section.blocks, *([best] if front else [])])


def _kind(sweep: SweepReport) -> str:
    return "trial" if sweep.trials else "run"


def _draws(draws: Draws) -> list[Section]:
    """How often drawn runs fail, and what their figures hang on: the strongest correlations."""
    columns = [
        Column("who", "who"),
        Column("draws", "draws"),
        Column("failures", "count"),
        Column("share", lambda each: _percent(each.share)),
        Column("95 % interval", _interval),
    ]
    counted = (
        f"Counted is a draw whose run ended in an error{_beyond(draws)}. The interval of 95 % is "
        "that of Clopper and Pearson for independent draws."
    )
    failures = [table(draws.failures, columns)] if draws.failures else []
    significant_rows = [
        each for each in draws.correlations if each.p is not None and each.p < _LEVEL
    ]
    rows = (significant_rows or draws.correlations[:5])[:_MOST_CORRELATIONS]
    words = (
        "Spearman's rank correlation of each drawn value with each figure, the strongest first: "
        f"{len(significant_rows)} of {len(draws.correlations)} are more than chance explains "
        f"(p < {_LEVEL:g}, adjusted for their number by Benjamini and Hochberg)"
    )
    if not significant_rows:
        words += "; the strongest are here, and may be chance"
    elif len(significant_rows) > len(rows):
        words += f"; the first {len(rows)} are here"
    columns = [
        Column("figure", "figure"),
        Column("who", "who"),
        Column("drawn value", "key"),
        Column("correlation", lambda each: f"{each.rho:+.2f}"),
        Column("adjusted p", "p"),
    ]
    correlations = [table(rows, columns, heads=3)] if rows else []
    return [
        Section("Failures among the draws", [counted], failures),
        Section("Sensitivities", [f"{words}."], correlations),
    ]


def _failures_sentence(draws: Draws) -> list[str]:
    """How often draws failed, for the head of the page; none where none did, or nobody counted."""
    failed = [each for each in draws.failures if each.count]
    if not failed:
        return []
    shares = ", ".join(
        f"{each.who} **{each.count} of {each.draws}** ({_percent(each.share)}, 95 % interval "
        f"{_interval(each)})"
        for each in failed[:6]
    )
    more = f", and {len(failed) - 6} more" if len(failed) > 6 else ""
    return [f"Draws that failed{_beyond(draws)}: {shares}{more}."]


def _beyond(draws: Draws) -> str:
    limits = ", ".join(f"{name} ≤ {bound:g}" for name, bound in draws.limits.items())
    return f", or that did not hold a limit ({limits})" if limits else ""


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f} %"


def _interval(share: FailureShare) -> str:
    if share.low is None or share.high is None:
        return "–"
    return f"{100 * share.low:.1f}\u2060–\u2060{100 * share.high:.1f} %"


def _failures(sweep: SweepReport) -> Section:
    reasons: dict[str, list[SweepRun]] = {}
    for run in sweep.runs:
        if run.failed:
            reason = (run.problem or run.outcome).strip().splitlines() or [run.outcome]
            reasons.setdefault(reason[0][:_LONGEST_REASON], []).append(run)
    often = sorted(reasons.items(), key=lambda item: -len(item[1]))[:_MOST_REASONS]
    columns = [
        Column("runs", lambda each: len(each[1])),
        Column("why", lambda each: each[0]),
        Column("which", lambda each: _names(each[1])),
    ]
    more = len(reasons) - len(often)
    caption = f"{more} more reasons are in the table below." if more > 0 else ""
    failed = [table(often, columns, caption)] if often else []
    columns = [
        Column("file that cannot be read", lambda each: each[0]),
        Column("why", lambda each: each[1][:_LONGEST_REASON]),
    ]
    unread = [table(sweep.left_out[:_MOST_REASONS], columns)] if sweep.left_out else []
    return Section("What failed", blocks=[*failed, *unread])


def _names(runs: Sequence[SweepRun]) -> str:
    return ", ".join([run.name for run in runs[:_MOST_NAMES]] + ["…"] * (len(runs) > _MOST_NAMES))


def _all_runs(sweep: SweepReport) -> Section:
    figures, alike = _apart(sweep)
    keys = [key for key in sweep.keys if key not in sweep.drawn_keys]
    random_keys = [key for key in sweep.keys if key in sweep.drawn_keys]
    columns = [("run", Column("run", lambda run: Datum(run.name, link=run.page)))]
    # A key that alone names who ran would say it twice.
    if len(sweep.entrants) > 1 and not any(map(sweep.names_entrants, sweep.keys)):
        columns.append(("who", Column("who", "entrant")))
    columns += [(key, Column(key, _value(key))) for key in keys]
    columns.append(("outcome", Column("outcome", "outcome")))
    columns += [(name, Column(sweep.title(name), _figure(name))) for name in figures]
    # They are many, and would push what came of them off the screen.
    columns += [(key, Column(key, _value(key))) for key in random_keys]
    if any(run.problem for run in sweep.runs):
        columns.append(("problem", Column("why it failed", "problem")))
    caption = "A click on a head sorts. On paper stand the first 200 rows."
    if alike:
        same = ", ".join(f"{sweep.title(name)} {value:.4g}" for name, value in alike.items())
        caption += f" The same for all that have it: {same}."
    if len(sweep.runs) > MOST_ROWS:
        caption += f" The first {MOST_ROWS} of {len(sweep.runs)} runs."
    example = _example(sweep)
    text = f"Filter by words and by columns, `{example}` for instance; all that is typed has to "
    rows = table(
        sweep.runs[:MOST_ROWS],
        [column for _, column in columns],
        caption,
        keys=[key.lower() for key, _ in columns],
        example=example,
    )
    return Section("All runs", [f"{text}hold."], [rows])


def _apart(sweep: SweepReport) -> tuple[list[str], dict[str, float]]:
    """Figures that tell runs apart, and those that are the same for all, with their value."""
    apart, alike = [], {}
    for name in sweep.figures:
        values = (value for run in sweep.runs if (value := run.figures.get(name)) is not None)
        first = next(values, None)
        if first is None:
            continue
        if len(sweep.runs) > 1 and all(value == first for value in values):
            alike[name] = first
        else:
            apart.append(name)
    return apart, alike


def _example(sweep: SweepReport) -> str:
    """A condition that about half of the runs fulfil."""
    for name in sweep.figures:
        values = [run.figures[name] for run in _drawn(sweep).runs if name in run.figures]
        if values:
            return f"{name.lower()}<{float(np.median(values)):.2g}"
    return "outcome=failed"


def _value_text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _value(key: str) -> Callable[[SweepRun], Cell]:
    return lambda run: run.values.get(key)


def _figure(name: str) -> Callable[[SweepRun], Cell]:
    return lambda run: run.figures.get(name)
