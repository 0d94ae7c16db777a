"""The step of the unscented filter: what is left out of it, or written out, changes nothing."""

import casadi as ca
import numpy as np
import pytest

from trms_cli.core.arrays import FloatArray
from trms_cli.models.model import names
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers import ukf
from trms_cli.observers.augmentation import Augmentation, augment
from trms_cli.observers.observer import ObserverSetup


def augmentation() -> Augmentation:
    model, outputs = Newtonian(), ("alpha_v", "alpha_h", "omega_v", "omega_h")
    setup = ObserverSetup(
        model,
        0.02,
        outputs,
        dict(zip(outputs, (1e-3, 1e-3, 1.0, 1.0), strict=True)),
        np.zeros(4),
        np.zeros(len(names(model.inputs))),
    )
    return augment(setup, ukf.Ukf())


def results(augmented: Augmentation, advance: float, mask: FloatArray) -> list[FloatArray]:
    points = ukf.SigmaPoints(augmented.n, alpha=0.7, beta=2.0, kappa=1.0)
    step = ukf.filter_step(augmented.alone(), points)
    draw = np.random.default_rng(1)
    root = augmented.sd[:, None] * np.tril(draw.uniform(0.1, 0.5, (augmented.n, augmented.n)))
    p = augmented.model.parameters.values
    y = np.array([0.1, -0.05, 5.0, 3.0])
    outputs = step(
        *(augmented.mean, root @ root.T, augmented.memory, [0.5, -0.3], y * mask, mask, advance),
        *(1e-4 * np.ones(augmented.model.n_w), p, augmented.q, augmented.r, augmented.floor),
        np.full(4, 400.0),
    )
    return [np.array(output) for output in outputs]


@pytest.mark.parametrize("advance", [0.0, 1.0])
@pytest.mark.parametrize("mask", [(1.0, 1.0, 1.0, 1.0), (1.0, 0.0, 1.0, 0.0)])
def test_sums_that_are_known_and_written_out_are_those_over_all_points(
    monkeypatch: pytest.MonkeyPatch, advance: float, mask: tuple[float, ...]
) -> None:
    augmented = augmentation()
    short = results(augmented, advance, np.array(mask))
    monkeypatch.setattr(ukf, "_MOST_WRITTEN_OUT", 0)
    monkeypatch.setattr(ca, "depends_on", lambda *_: True)  # every point is measured
    for ours, full in zip(short, results(augmented, advance, np.array(mask)), strict=True):
        np.testing.assert_allclose(ours, full, rtol=1e-10, atol=1e-14)
