"""What a colleague would say of the figures: sentences, each with a judgement.

They are made from the document's figures alone, so that what is said and what is written agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

Judgement = Literal["good", "bad", "doubtful", ""]

WORDS: Mapping[str, str] = MappingProxyType(
    {
        "alpha_v": "pitch",
        "alpha_h": "yaw",
        "omega_v": "main rotor speed",
        "omega_h": "tail rotor speed",
        "u_v": "main command",
        "u_h": "tail command",
    }
)
#: An error up to this many times the declared noise is the noise's.
_AT_THE_NOISE = 1.5
#: Error over that of predicting no change: below the first it is good, below the second better
#: than nothing.
_GOOD, _USEFUL = 0.3, 0.9
#: A quarter of the time with this much of the squared error is worth a sentence.
_CONCENTRATED = 0.5
#: Models whose errors differ by less than this share are alike for all purposes.
SMALL = 0.02
#: Most sentences on failed tests.
_MOST_TESTS = 6
#: Kinds of tests that a right model fails too where its outputs are quantised.
_WHITENESS = ("auto", "ljung_box", "other")


class Remark(NamedTuple):
    """A sentence with its judgement."""

    text: str
    judgement: Judgement = ""


def word(name: str) -> str:
    """A signal in words."""
    return WORDS.get(name, name)


def quantity_words(value: float | None, unit: str) -> str:
    """A figure with its unit, small angles in mrad."""
    if value is None:
        return "–"
    if unit.startswith("rad") and unit != "rad/s" and abs(value) < 0.1:
        return f"{_digits(1e3 * value)} m{unit}"
    return _digits(value) if unit == "1" else f"{_digits(value)} {unit}"


def _digits(value: float) -> str:
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"{value:.1e}"


def lead_of(document: Mapping[str, Any]) -> list[str]:
    """The sentences on top."""
    if "models" in document:
        return _lead_of_several(document)
    return _lead_of_one(document)


def _lead_of_one(document: Mapping[str, Any]) -> list[str]:
    horizon = _last(document)
    groups: dict[str, list[str]] = {"noise": [], "good": [], "useful": [], "bad": []}
    for channel, rows in document["by_horizon"].items():
        groups[_grade(document, channel, rows[horizon])].append(
            f"{word(channel)} to {quantity_words(rows[horizon]['rms'], document['units'][channel])}"
        )
    parts = [
        f"{beginning} {_listed(groups[key])}"
        for key, beginning in (
            ("noise", "foretells down to the sensor's noise:"),
            ("good", "foretells well:"),
            ("useful", "foretells roughly:"),
            ("bad", "is no better than predicting no change in:"),
        )
        if groups[key]
    ]
    first = f"Left alone for {float(horizon):g} s, {document['model']} {'; '.join(parts)} (RMS)."
    tests = document["residual_tests"]
    if tests["failed"]:
        kinds = _failing(document)
        second = (
            f"One step ahead, {tests['failed']} of {tests['count']} residual tests find something "
            f"that the model leaves unexplained, first in {_listed(list(kinds)[:3])}."
        )
    else:
        second = (
            f"One step ahead, none of {tests['count']} residual tests finds anything that the "
            "model leaves unexplained."
        )
    return [first, second]


def _lead_of_several(document: Mapping[str, Any]) -> list[str]:
    ranking = document["ranking"]
    best = ranking[0]
    sentences = []
    if best["relative_error"] is None:
        return ["None of the models can be ranked: no error is finite, or nothing moves."]
    against = next(
        (
            pair
            for pair in document["comparison"]
            if pair["models"] == [best["model"], ranking[1]["model"]]
        ),
        None,
    )
    lasting = document["models"][best["model"]]
    horizon = _last(lasting)
    errors = [
        f"{word(c)} {quantity_words(rows[horizon]['rms'], lasting['units'][c])}"
        for c, rows in lasting["by_horizon"].items()
    ]
    if against is not None and against["ratio"] is not None:
        ratio = f"{against['ratio']:.3g}"
        if against["ci95"][0] is not None:
            ratio += f" (95 % interval {against['ci95'][0]:.3g} to {against['ci95'][1]:.3g})"
        if against["differ"] and abs(against["ratio"] - 1.0) < SMALL:
            sentences.append(
                f"{best['model']} and {ranking[1]['model']} foretell alike: the errors of the "
                f"first are {ratio} times those of the second, on average over channels and "
                "horizons."
            )
        elif against["differ"]:
            sentences.append(
                f"{best['model']} foretells best: its errors are {ratio} times those of "
                f"{ranking[1]['model']}, on average over channels and horizons."
            )
        else:
            sentences.append(
                f"{best['model']} has the smallest errors, but these recordings do not tell it "
                f"from {ranking[1]['model']}: its errors are {ratio} times the other's."
            )
    sentences.append(f"Left alone for {float(horizon):g} s it errs by {_listed(errors)} (RMS).")
    return sentences


def remarks_on(document: Mapping[str, Any]) -> list[Remark]:
    """One model's figures in sentences: errors, tests, regions."""
    return [
        *_on_errors(document),
        *_on_belief(document),
        *_on_tests(document),
        *_on_regions(document),
    ]


def _on_errors(document: Mapping[str, Any]) -> Iterator[Remark]:
    for channel, rows in document["by_horizon"].items():
        unit = document["units"][channel]
        chosen = list(rows)[-2:]
        errors = _listed(
            [f"{quantity_words(rows[h]['rms'], unit)} over {float(h):g} s" for h in chosen]
        )
        naive = _listed([quantity_words(rows[h]["unchanged_rms"], unit) for h in chosen])
        grades = [_grade(document, channel, rows[h]) for h in chosen]
        judgement: Judgement = "doubtful"
        if "bad" in grades:
            judgement = "bad"
        elif "useful" not in grades:
            judgement = "good"
        text = f"**{word(channel)}**: {errors}; predicting no change errs by {naive}"
        fit = rows[chosen[-1]]["fit_percent"]
        if fit is not None:
            text += f"; fit {fit:.0f} %".replace("-", "−")
        if set(grades) == {"noise"}:
            noise = quantity_words(document["noise_sd"][channel], unit)
            text += f". That is the sensor's noise ({noise})"
        yield Remark(text + ".", judgement)


def _on_belief(document: Mapping[str, Any]) -> Iterator[Remark]:
    off = {
        channel: figures["normalised_square"]
        for channel, figures in document["one_step"].items()
        if figures["normalised_square"] is not None and not 0.4 < figures["normalised_square"] < 2.0
    }
    if off:
        parts = _listed([f"{word(c)} {value:.2g}" for c, value in off.items()])
        yield Remark(
            f"The one-step errors are not as wide as the declared noise and the filter expect "
            f"(mean square over expected: {parts}; 1 is right): `data.noise_sd` may be wrong.",
            "doubtful",
        )


def _on_tests(document: Mapping[str, Any]) -> Iterator[Remark]:
    tests = document["residual_tests"]
    level = f"{100 * tests['level']:g} %"
    if not tests["count"] or all(test["p"] is None for test in tests["tests"]):
        yield Remark("No residual test could be made: too few samples.", "doubtful")
        return
    if not tests["failed"]:
        yield Remark(
            f"None of {tests['count']} residual tests fails (a false alarm in any: {level}).",
            "good",
        )
        return
    failed = sorted((test for test in tests["tests"] if test["failed"]), key=lambda test: test["p"])
    coloured = [test for test in failed if test["name"] in _WHITENESS]
    if coloured:
        channels = _listed(list(dict.fromkeys(word(test["channel"]) for test in coloured)))
        largest = max(abs(test["largest_correlation"] or 0.0) for test in coloured)
        text = (
            f"The one-step errors of {channels} are correlated in time (up to {largest:.2f}): a "
            "missing lag or state, or the noise model."
        )
        if tests["calibration"] == "asymptotic":
            text += (
                " A quantised angle does that to a right model too: `tests.calibration=simulated` "
                "tells the two apart."
            )
        yield Remark(text, "doubtful" if len(coloured) == len(failed) else "bad")
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for test in failed:
        if test["name"] not in _WHITENESS:
            groups.setdefault((test["channel"], test["meaning"]), []).append(test)
    for (channel, meaning), found in list(groups.items())[:_MOST_TESTS]:
        inputs = [" × ".join(word(name) for name in test["inputs"]) for test in found]
        of = f" ({_listed(inputs)})" if any(inputs) else ""
        size = ""
        if found[0]["name"] != "mean":
            largest = max(abs(test["largest_correlation"] or 0.0) for test in found)
            size = f" correlation up to {largest:.2f},"
        p = p_words(found[0]["p_holm"])
        yield Remark(f"**{word(channel)}**: {meaning}{of};{size} {p}.", "bad")
    rest = sum(len(found) for found in list(groups.values())[_MOST_TESTS:])
    if rest:
        yield Remark(f"{rest} more tests fail: see the table.", "bad")


def p_words(p: float | None) -> str:
    """A p-value over the whole family, in words."""
    if p is None:
        return "no p-value"
    return "p < 0.001" if p < 1e-3 else f"p = {p:.2g}"


def _on_regions(document: Mapping[str, Any]) -> Iterator[Remark]:
    """Per channel, the quarter of the time with most of the error, if it is much."""
    horizon = document["regions"]["horizon_s"]
    for channel, rows in document["by_horizon"].items():
        row = rows.get(repr(float(horizon)))
        if row is None or _grade(document, channel, row) == "noise":
            continue
        found = [
            (share, low, high, time, table["variable"])
            for table in document["regions"]["tables"]
            if table["channel"] == channel
            for low, high, time, share in [worst_quarter(table)]
        ]
        if not found:
            continue
        share, low, high, time, variable = max(found)
        if share >= max(_CONCENTRATED, 1.5 * time):
            unit = document["units"].get(variable, "")
            yield Remark(
                f"{100 * share:.0f} % of the squared error of {word(channel)} over {horizon:g} s "
                f"lies where {word(variable)} is between {_digits(low)} and {_digits(high)} {unit}"
                f"{' ' if unit else ''}({100 * time:.0f} % of the time).",
                "doubtful",
            )


def worst_quarter(table: Mapping[str, Any]) -> tuple[float, float, float, float]:
    """From, to, share of time, share of error of the worst neighbouring quarter of the bins.

    ``table``: a region table of the document: edges, time_share, error_share.
    """
    error, time, edges = table["error_share"], table["time_share"], table["edges"]
    width = max(1, len(error) // 4)
    i = max(
        range(len(error) - width + 1),
        key=lambda k: sum(error[k : k + width]) / sum(time[k : k + width]),
    )
    return edges[i], edges[i + width], sum(time[i : i + width]), sum(error[i : i + width])


def remarks_on_comparison(document: Mapping[str, Any]) -> list[Remark]:
    """Pairs of models in sentences."""
    remarks = []
    for pair in document["comparison"]:
        one, other = pair["models"]
        if pair["ratio"] is None:
            continue
        ratio = f"{pair['ratio']:.3g}"
        if pair["ci95"][0] is not None:
            ratio += f" ({pair['ci95'][0]:.3g} to {pair['ci95'][1]:.3g})"
        text = f"{one} errs {ratio} times as much as {other}"
        if not pair["differ"]:
            remarks.append(Remark(f"{text}: these recordings do not tell.", "doubtful"))
        elif abs(pair["ratio"] - 1.0) < SMALL:
            remarks.append(Remark(f"{text}: more than chance, and next to nothing.", "doubtful"))
        else:
            remarks.append(Remark(f"{text}: more than chance.", "good"))
    return remarks


def _grade(document: Mapping[str, Any], channel: str, row: Mapping[str, Any]) -> str:
    error, naive = row["rms"], row["unchanged_rms"]
    if error is None:
        return "bad"
    if error <= _AT_THE_NOISE * document["noise_sd"][channel]:
        return "noise"
    if not naive or error > _USEFUL * naive:
        return "bad"
    return "good" if error <= _GOOD * naive else "useful"


def _failing(document: Mapping[str, Any]) -> dict[str, None]:
    """Channels with failed tests, worst first."""
    failed = [test for test in document["residual_tests"]["tests"] if test["failed"]]
    failed.sort(key=lambda test: test["p"])
    return dict.fromkeys(word(test["channel"]) for test in failed)


def _last(document: Mapping[str, Any]) -> str:
    rows = next(iter(document["by_horizon"].values()))
    return list(rows)[-1]


def _listed(items: Sequence[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
