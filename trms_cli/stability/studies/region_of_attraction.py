"""Which starts come to rest at an equilibrium: estimates that are proved, and the region itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.findings import Findings, json_data
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint, operating_point
from trms_cli.stability.attraction.loop_region import loop_findings, loop_region
from trms_cli.stability.attraction.region import RegionOptions, attraction_region
from trms_cli.stability.attraction.report import lead, results, sections, warnings
from trms_cli.stability.attraction.system import around, require_attractive
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject

Method = Literal["lyapunov", "inclusion", "level_set", "integrals", "quartic"]
_HalfWidth = Annotated[float, Meta(gt=0)]
TITLE = "Region of attraction"


@dataclass(frozen=True, kw_only=True)
class RegionOfAttraction:
    """Estimates of a region of attraction beside the region by simulation."""

    #: Equilibrium: angles (rad) or commands (V). Empty: a main command of 1.8 V, or the rest
    #: without command where the model has no equilibrium at that; with a controller, level, and yaw
    #: at 0.3 rad, where the tail rotor turns.
    at: Mapping[str, float] = field(default_factory=dict)
    #: sequence of str, "all" or None; in which starts deviate. None: the angles and what moves with
    #: them, the rotors at their speed.
    states: Sequence[str] | Literal["all"] | None = None
    #: Half-widths of the box of starts by state; what is not named is chosen
    box: Mapping[str, _HalfWidth] = field(default_factory=dict)
    #: The two states of the figure. Empty: the last angle and its rate; in a loop of two axes both
    #: angles.
    plane: Sequence[str] = ()
    #: ``lyapunov``, ``inclusion``, ``level_set``, ``integrals``, ``quartic``. None: all; of more
    #: than three states without the last two.
    methods: Sequence[Method] | None = None
    boxes: Annotated[int, Meta(ge=100, le=10_000_000)] = 40_000  #: Boxes that one proof may take
    #: Random starts, from which the share of the true region is counted. None: 2000, of more than
    #: three states 500.
    samples: Annotated[int, Meta(ge=20, le=1_000_000)] | None = None
    #: Starts along each side of the figure. None: 61, of more than three states 31.
    grid: Annotated[int, Meta(ge=5, le=401)] | None = None
    #: s, after which a motion is undecided. None: ten time constants of the slowest mode, at most
    #: 240 s, of more than three states 120 s; 20 s in a loop.
    duration: Annotated[float, Meta(gt=0)] | None = None
    #: Starts from which the loop itself is run, with controller and observer
    loop_starts: Annotated[int, Meta(ge=2, le=100_000)] = 24
    tolerance: Annotated[float, Meta(gt=0)] = 0.02  #: Of the angles at the end of such a run, rad

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Estimate, prove, and simulate.

        Raises TrmsError for an equilibrium that is unstable or marginal, and for a model without
        equations.
        """
        model = subject.require_equations(
            "study=region_of_attraction", "replay the model from the starts of interest (trms run)"
        )
        options = RegionOptions(
            self.methods, self.box, self.plane, self.boxes, self.samples, self.grid, self.duration
        )
        if subject.loop is not None:
            point = operating_point(model, self.at or _level(model.controlled), "study.at")
            chosen = () if self.states in (None, "all") else tuple(self.states or ())
            result = loop_region(
                subject, point, options, chosen, self.loop_starts, self.tolerance, tell
            )
            return loop_findings(result, self.plane, TITLE)
        point = self._point(model)
        system = around(
            model,
            point,
            model.state_names if self.states == "all" else self.states or model.controlled,
        )
        require_attractive(system)
        region = attraction_region(system, options, tell)
        left_out = subject.left_out_of_equations()
        notes = warnings(region)
        if left_out:
            notes.append(
                f"{', '.join(left_out)} {'is' if len(left_out) == 1 else 'are'} no part of the "
                "equations, neither in the proofs nor in these simulations."
            )
        return Findings(TITLE, lead(region), sections(region), json_data(results(region)), notes)

    def _point(self, model: Model) -> OperatingPoint:
        if self.at:
            return operating_point(model, self.at, "study.at")
        try:
            return operating_point(model, {"u_v": 1.8})
        except ConfigurationError:
            # No such command, or no rest there (a yaw that nothing holds turns with it).
            return operating_point(model, {}, "study.at")


def _level(controlled: Sequence[str]) -> dict[str, float]:
    return {name: 0.3 if name == "alpha_h" else 0.0 for name in controlled}
