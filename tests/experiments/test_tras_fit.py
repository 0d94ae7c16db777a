"""The study on the TRAS: what it decides beforehand, and that it runs without the record."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.tras_fit.__main__ import main
from experiments.tras_fit.study import model_of, read_study
from trms_cli.identification.problem import Prior, free_parameters


def test_skips_where_there_is_no_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 0
    assert "skipped" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["rotors", "commands"])
def test_its_free_parameters_exist(name: str) -> None:
    settings = read_study()
    fit = {**settings["fits"][name], "curves": False}
    model = model_of(Path(), settings, fit)
    priors = {key: Prior(relative_sd=share) for key, share in fit["priors"].items()}
    free = free_parameters(model.parameters, fit["free"], priors=priors)
    assert len(free) == len(fit["free"])
