"""What the studies of a rig and a model give back: fits, validations, diagnoses and others."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from trms_cli.core.findings import Findings, Section, Table
from trms_cli.library import html
from trms_cli.library.frames import frame_of
from trms_cli.library.result import Result

if TYPE_CHECKING:
    import pandas  # type: ignore[import-untyped,unused-ignore]


class StudyResult(Result):
    """What a study gives back: it shows itself by its findings."""

    @property
    def findings(self) -> Findings:
        """What is worth telling of it."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        named = {key: self.folder / name for key, name in self.FILES.items()}
        written = {key: path for key, path in named.items() if path.is_file()}
        shown = html.findings(self.findings, self.headline, {**written, "page": self.report})
        return shown + "".join(html.picture(f.read_bytes()) for f in self.pictures.values())


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

    @property
    def findings(self) -> Findings:
        """What is worth telling of it."""
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
            for name, found in self._models.items()
            for channel, by in found["error"].items()
        }
        horizons = sorted({h for row in rows.values() for h in row})
        columns = {h: [row.get(h) for row in rows.values()] for h in horizons}
        units = {c: u for found in self._models.values() for c, u in found["units"].items()}
        from trms_cli.library.frames import load_pandas

        index = load_pandas().MultiIndex.from_tuples(list(rows), names=["model", "channel"])
        return frame_of(columns, units, index)

    @property
    def _models(self) -> dict[str, Any]:
        found = self.document.get("models")
        return found if found else {str(self.document["model"]): self.document}

    @property
    def headline(self) -> str:
        """Which models over which recordings."""
        over = ", ".join(recording["name"] for recording in self.document["recordings"])
        return f"{', '.join(self._models)} over {over}"

    @property
    def findings(self) -> Findings:
        """What is worth telling of it."""
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

    @property
    def findings(self) -> Findings:
        """What is worth telling of it."""
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
        """``effect``, ``effects``, ``parameters``, ``none_of_these``, ``no_gap``, …"""
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

    @property
    def findings(self) -> Findings:
        """What is worth telling of it."""
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
        from trms_cli.library.frames import load_pandas

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

    @property
    def findings(self) -> Findings:
        """What is worth telling of it."""
        from trms_cli.identification.excitation.findings import findings

        return findings(self.document)
