"""What an observer gives and a controller takes: the state that is believed in."""

from dataclasses import dataclass, field

import numpy as np

from trms_cli.core.arrays import FloatArray


@dataclass
class Estimate:
    """What is known after a measurement. The arrays may be overwritten by the next step."""

    #: ``x``, ``sd``: (n_x,) arrays; state of the model (without memory) and its standard deviations
    x: FloatArray
    sd: FloatArray
    #: (n_w,) arrays; Disturbances on the model's equations, known ones included
    disturbance: FloatArray
    disturbance_sd: FloatArray  #: (n_w,) arrays; zero where there is none
    #: (n_y,) array; measurement predicted before it was seen
    predicted: FloatArray = field(default_factory=lambda: np.zeros(0))
    #: ``innovation``, ``innovation_sd``: (n_y,) arrays; measured minus predicted, NaN where
    #: missing, and what the observer expects of it
    innovation: FloatArray = field(default_factory=lambda: np.zeros(0))
    innovation_sd: FloatArray = field(default_factory=lambda: np.zeros(0))
    #: (n_y,) array; 1 where a sample was there and not believed, else 0; empty for an observer
    #: without a gate
    rejected: FloatArray = field(default_factory=lambda: np.zeros(0))
