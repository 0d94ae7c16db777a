"""``-m``: many runs from one command line, through Hydra's own main, sweepers and launchers.

Each job gets its numbered folder and in it ``status.json`` (schema ``trms.status/1``), written
when it starts and when it ends: ``state`` is ``running``, ``done``, ``failed`` or
``interrupted``. A failed job does not stop the others.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trms_cli.commands.catalogue import (
    Primary,
    config_folder,
    make_importable,
    read_groups,
    read_primary,
)
from trms_cli.commands.composition import Composition, Outcome, Task, checked, compose
from trms_cli.commands.composition_errors import explained
from trms_cli.commands.overrides import Request, parse, prepare, quoted
from trms_cli.commands.run_folder import new_folder
from trms_cli.core.errors import EXIT_OK, EXIT_WORSE, TrmsError

STATUS_FILE = "status.json"


@dataclass(frozen=True)
class _Job:
    """What Hydra calls for each job, in this process or a launcher's."""

    request: Request
    declared: Primary
    task: Task

    def __call__(self, composed: Any) -> float | None:
        """Run one job and return the figure that the sweeper minimises; nan for a failed one."""
        from hydra.core.hydra_config import HydraConfig
        from omegaconf import OmegaConf

        make_importable(self.request.config_dirs)
        hydra = HydraConfig.get()
        folder = Path(hydra.runtime.output_dir)
        request = self.request._replace(overrides=tuple(hydra.overrides.task))
        status: dict[str, Any] = {
            "schema": "trms.status/1",
            "job": int(hydra.job.num),
            "overrides": list(request.overrides),
        }
        _write(folder, status | {"state": "running", "pid": os.getpid()})
        try:
            choices = OmegaConf.to_container(hydra.runtime.choices)
            assert isinstance(choices, dict)
            status["choices"] = {k: v for k, v in choices.items() if not str(k).startswith("hydra")}
            composition = checked(composed, self.declared, choices, request, int(hydra.job.num))
            composition.config["out"] = str(folder)
            status["choices"] = composition.choices
            outcome = self.task(composition)
        except KeyboardInterrupt:
            _write(folder, status | {"state": "interrupted"})
            raise
        except Exception as error:
            _write(folder, status | {"state": "failed", "error": _described(error)})
            return float("nan")
        if not isinstance(outcome, Outcome):
            outcome = Outcome(outcome)
        state = "done" if outcome.exit_code == EXIT_OK else "failed"
        ending = {"state": state, "exit_code": outcome.exit_code, "objective": outcome.objective}
        _write(folder, status | ending)
        return outcome.objective


def sweep(request: Request, primary: str, task: Task) -> int:
    """Run every combination that the overrides ask for, and tell which jobs failed.

    Returns
    -------
    int
        0 when every job ended well, 1 otherwise.
    """
    declared = read_primary(primary, request.config_dirs)
    groups = read_groups(request.config_dirs)
    asked = [text for text in request.overrides if parse(text, groups).key == "out"]
    out = parse(asked[-1], groups).value if asked else None
    rest = tuple(text for text in request.overrides if text not in asked)
    request = request._replace(overrides=rest)
    overrides = prepare(request, declared, groups)
    make_importable(request.config_dirs)
    _first_job(overrides, request, primary)

    folder = new_folder(None if out in (None, "null", "") else out.strip("'\""), f"{primary}-sweep")
    settings = [
        f"hydra.sweep.dir={quoted(str(folder.resolve()))}",
        "hydra.sweep.subdir=${hydra.job.num}",
        "hydra.output_subdir=null",
        "hydra/job_logging=none",
        "hydra/hydra_logging=none",
    ]
    try:
        with explained(overrides, declared, groups, lambda _: {}):
            _hydra_main([*overrides, *settings], primary, _Job(request, declared, task), request)
    except TrmsError:
        if not any(folder.glob(f"*/{STATUS_FILE}")):  # refused before the first job
            shutil.rmtree(folder)
        raise
    except KeyboardInterrupt:
        _tell(folder)
        raise
    return _tell(folder)


def first_job(request: Request, primary: str) -> Composition:
    """The configuration of a sweep's first job, for ``-m --cfg job``."""
    declared = read_primary(primary, request.config_dirs)
    return _first_job(
        prepare(request, declared, read_groups(request.config_dirs)), request, primary
    )


def _first_job(overrides: Sequence[str], request: Request, primary: str) -> Composition:
    """Compose the first job alone: its errors name the key, those inside a sweep do not."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    first = []
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        text = str(override.input_line)
        if override.is_hydra_override():
            continue
        if override.is_discrete_sweep():
            text = f"{text.partition('=')[0]}={next(iter(override.sweep_string_iterator()))}"
        elif override.is_sweep_override():
            continue
        first.append(text)
    folders = [word for place in request.config_dirs for word in ("--config-dir", str(place))]
    return compose([*folders, *first], primary)


def _hydra_main(overrides: Sequence[str], primary: str, job: _Job, request: Request) -> None:
    import hydra

    from trms_cli.commands.search_path import HYDRA_VERSION_BASE, user_folders

    # Hydra owns sys.argv, and tells errors by printing unless it is asked for the exception
    argv, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [f"trms {primary}", "--multirun", *overrides]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        with user_folders(request.config_dirs):
            decorate = hydra.main(
                config_path=str(config_folder()),
                config_name=primary,
                version_base=HYDRA_VERSION_BASE,
            )
            decorate(job)()
    finally:
        sys.argv = argv
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full_error


def _write(folder: Path, status: dict[str, Any]) -> None:
    """Replace the status in one step: a reader never sees half of it."""
    draft = folder / f".{STATUS_FILE}"
    draft.write_text(json.dumps(status, ensure_ascii=False, indent=2) + "\n", encoding="utf-8")
    draft.replace(folder / STATUS_FILE)


def _described(error: Exception) -> dict[str, str]:
    if isinstance(error, TrmsError):
        return {"problem": error.problem, "where": error.where, "remedy": error.remedy}
    return {
        "problem": f"{type(error).__name__}: {error}",
        "trace": "".join(traceback.format_exception(error)),
    }


def _tell(folder: Path) -> int:
    files = sorted(folder.glob(f"*/{STATUS_FILE}"), key=lambda file: (len(str(file)), str(file)))
    failed = 0
    for file in files:
        status = json.loads(file.read_text(encoding="utf-8"))
        if status["state"] != "done":
            failed += 1
            error = status.get("error", {})
            words = [f"job {status['job']} {status['state']}:", " ".join(status["overrides"])]
            sys.stderr.write(" ".join(words) + "\n")
            for part in ("problem", "where", "remedy"):
                if error.get(part):
                    sys.stderr.write(f"    {error[part]}\n")
    sys.stdout.write(f"{len(files) - failed} of {len(files)} jobs done: {folder}\n")
    return EXIT_OK if not failed else EXIT_WORSE
