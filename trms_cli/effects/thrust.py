"""What changes a rotor's thrust, and with it the torque on the beam."""

import casadi as ca

from trms_cli.effects.effect import Effect, EffectContext, axis_of, require_quantities, speed_row
from trms_cli.models.model import Model


class ThrustEffect(Effect):
    """A change of one rotor's thrust; the model has to name the thrust and its arm."""

    rotor: str

    @property
    def locations(self) -> tuple[str, ...]:
        return (f"{self.rotor}_thrust",)

    def check(self, model: Model) -> None:
        speed_row(model, self.rotor)
        axis_of(model, model.rotors[self.rotor].axis)
        require_quantities(model, f"thrust_{self.rotor}", f"arm_{self.rotor}")

    def torque(self, at: EffectContext, thrust: ca.SX) -> ca.SX:
        """The disturbance vector (n_w, 1) of an additional thrust (N) at its arm."""
        return at.on(
            at.axis(at.model.rotors[self.rotor].axis).moment,
            at.quantity(f"arm_{self.rotor}") * thrust,
        )
