"""A trained network as data: what it computes, exactly, and how it is written down.

A network maps a regressor φ to an output, both normalised by figures that stay with it::

    z = (φ − regressor_mean) / regressor_sd        output = output_mean + output_sd · N(z)

    mlp      N(z) = W_L f(… f(W_1 z + b_1) …) + b_L  [+ A z]
    rbf      N(z) = b + A z + W g(r),   g(r) = exp(−r²/2)
    wavelet  N(z) = b + A z + W g(r),   g(r) = (n_z − r²) exp(−r²/2)      r_i = ‖z − c_i‖ / d_i
    polynomial  N(z) = b + A z + W m(z),   m_i(z) = Π_j z_j^e_ij

The wavelet is the radial Mexican hat (Zhang 1997, IEEE Trans. Neural Networks 8(2), after Zhang
& Benveniste 1992, IEEE Trans. Neural Networks 3(6)); its direct linear part is theirs too.

The activation f of a perceptron's hidden layers is one of::

    tanh      tanh(s)
    logistic  1 / (1 + exp(−s))
    softplus  log(1 + exp(s)), the smooth form of the rectifier max(0, s)
    linear    s: the network is a linear model
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, ClassVar, Literal, TypeVar, get_args

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.model import FloatArray

T = TypeVar("T")

Kind = Literal["mlp", "rbf", "wavelet", "polynomial"]
Activation = Literal["tanh", "logistic", "softplus", "linear"]
ACTIVATIONS: tuple[Activation, ...] = get_args(Activation)
_FIGURES = ("regressor_mean", "regressor_sd", "output_mean", "output_sd")


@dataclass(frozen=True, eq=False)
class Network:
    """A static map with its normalisation.

    Raises ModelError for shapes that do not fit, a figure that is not finite, or a scale that is
    not positive.
    """

    kind: Kind
    #: mlp: ``W1`` (h_1, n_z), ``b1`` (h_1,), … up to the output layer ``WL`` (n_out, h), ``bL``
    #: (n_out,), and, where there is a direct linear part, ``A`` (n_out, n_z). rbf, wavelet:
    #: ``centres`` (n_c, n_z), ``widths`` (n_c,), ``W`` (n_out, n_c), ``A`` (n_out, n_z), ``b``
    #: (n_out,). polynomial: the same with whole ``exponents`` (n_c, n_z) in place of centres and
    #: widths. All in normalised units.
    weights: Mapping[str, FloatArray]
    regressor_mean: FloatArray  #: (n_phi,), in the regressor's units
    regressor_sd: FloatArray  #: (n_phi,), likewise
    output_mean: FloatArray  #: (n_out,), in the output's units
    output_sd: FloatArray  #: (n_out,), likewise
    activation: Activation = "tanh"  #: Of the hidden layers of an mlp; others have their own units

    def __post_init__(self) -> None:
        for name in _FIGURES:
            object.__setattr__(self, name, _array(getattr(self, name), 1, name))
        weights = {
            name: _array(value, 1 if _is_vector(name) else 2, f"weights.{name}")
            for name, value in self.weights.items()
        }
        object.__setattr__(self, "weights", weights)
        if self.kind not in get_args(Kind):
            raise ModelError(
                f"{self.kind!r} given", where="kind", remedy=f"one of {', '.join(get_args(Kind))}"
            )
        if self.activation not in ACTIVATIONS:
            raise ModelError(
                f"{self.activation!r} given",
                where="activation",
                remedy=f"one of {', '.join(ACTIVATIONS)}",
            )
        self._check_shapes()
        for name in ("regressor_sd", "output_sd"):
            if not np.all(getattr(self, name) > 0):
                raise ModelError("a scale is not positive", where=name, remedy="train again")

    @property
    def n_regressors(self) -> int:
        return int(self.regressor_mean.size)

    @property
    def n_outputs(self) -> int:
        return int(self.output_mean.size)

    @property
    def n_layers(self) -> int:
        """Layers of weights of an mlp, the output layer among them."""
        return sum(1 for name in self.weights if name.startswith("W"))

    def expression(self, regressor: ca.SX, weights: Mapping[str, ca.SX] | None = None) -> ca.SX:
        """The output as a CasADi expression, exact to rounding and with exact derivatives.

        ``regressor``: (n_phi, 1) casadi.SX. ``weights``: of an mlp, symbols in place of its own
        weights. Returns (n_out, 1) casadi.SX.
        """
        z = (regressor - ca.DM(self.regressor_mean)) / ca.DM(self.regressor_sd)
        w = weights or {name: ca.DM(value) for name, value in self.weights.items()}
        if self.kind == "mlp":
            last = self.n_layers
            activation = z
            for layer in range(1, last):
                sums = w[f"W{layer}"] @ activation + w[f"b{layer}"]
                activation = _activation_expression(self.activation, sums)
            result = w[f"W{last}"] @ activation + w[f"b{last}"]
        elif self.kind == "polynomial":
            result = w["W"] @ ca.vertcat(*self._monomials(z)) + w["b"]
        else:
            activations = []
            for centre, width in zip(self.weights["centres"], self.weights["widths"], strict=True):
                square = ca.sumsqr((z - ca.DM(centre)) / width)
                bell = ca.exp(-square / 2)
                activations.append(bell if self.kind == "rbf" else (z.shape[0] - square) * bell)
            result = w["W"] @ ca.vertcat(*activations) + w["b"]
        if "A" in w:
            result += w["A"] @ z
        return ca.DM(self.output_mean) + ca.DM(self.output_sd) * result

    def evaluate(self, regressors: FloatArray) -> FloatArray:
        """The outputs for many regressors at once, ``(n, n_phi) -> (n, n_out)``."""
        z = (regressors - self.regressor_mean) / self.regressor_sd
        w = self.weights
        if self.kind == "mlp":
            last = self.n_layers
            activation = z
            for layer in range(1, last):
                sums = activation @ w[f"W{layer}"].T + w[f"b{layer}"]
                activation = activated(self.activation, sums)
            result = activation @ w[f"W{last}"].T + w[f"b{last}"]
        elif self.kind == "polynomial":
            columns = [np.ravel(m) for m in self._monomials(z.T)]
            result = np.column_stack(columns) @ w["W"].T + w["b"]
        else:
            square = squared_distances(z, w["centres"]) / w["widths"] ** 2
            bell = np.exp(-square / 2)
            hidden = bell if self.kind == "rbf" else (z.shape[1] - square) * bell
            result = hidden @ w["W"].T + w["b"]
        if "A" in w:
            result = result + z @ w["A"].T
        return np.asarray(self.output_mean + self.output_sd * result)

    def _monomials(self, z: Any) -> list[Any]:
        """Products of the regressors, z[j] each, by repeated multiplication."""
        monomials = []
        for row in self.weights["exponents"].astype(int):
            factors = [z[j] for j in np.repeat(np.arange(len(row)), row)]
            monomial = factors[0]
            for factor in factors[1:]:
                monomial = monomial * factor
            monomials.append(monomial)
        return monomials

    def to_data(self) -> dict[str, Any]:
        """Plain data for a YAML file; read back, every bit is there."""
        weights = {name: value.tolist() for name, value in self.weights.items()}
        figures = {name: getattr(self, name).tolist() for name in _FIGURES}
        activation = {} if self.activation == "tanh" else {"activation": self.activation}
        return {"kind": self.kind, **activation, **figures, "weights": weights}

    @classmethod
    def from_data(cls, data: Mapping[str, Any], where: str = "network") -> Network:
        """The network of :meth:`to_data`.

        Raises ModelError for a key that is missing or unknown, and for figures that do not fit; it
        names the key.
        """
        check_keys(data, {"kind", "weights", *_FIGURES}, where, {"activation"})
        if not isinstance(data["weights"], Mapping):
            raise ModelError(
                "no mapping of weights", where=f"{where}.weights", remedy="train again"
            )
        try:
            return cls(**data)
        except ModelError as error:
            raise ModelError(
                error.problem, where=f"{where}.{error.where}", remedy=error.remedy
            ) from None

    def _check_shapes(self) -> None:
        n_z, n_out = self.n_regressors, self.n_outputs
        expected: dict[str, tuple[int, ...]] = {}
        if self.kind == "mlp":
            before = n_z
            for layer in range(1, self.n_layers + 1):
                rows = self.weights[f"W{layer}"].shape[0] if f"W{layer}" in self.weights else -1
                after = n_out if layer == self.n_layers else rows
                expected |= {f"W{layer}": (after, before), f"b{layer}": (after,)}
                before = after
            if not expected:
                expected = {"W1": (n_out, n_z), "b1": (n_out,)}
            if "A" in self.weights:
                expected["A"] = (n_out, n_z)
        else:
            first = "exponents" if self.kind == "polynomial" else "centres"
            n_c = len(self.weights[first]) if first in self.weights else -1
            expected = {first: (n_c, n_z), "W": (n_out, n_c)}
            expected |= {} if self.kind == "polynomial" else {"widths": (n_c,)}
            expected |= {"A": (n_out, n_z), "b": (n_out,)}
        expected |= {"regressor_sd": (n_z,), "output_sd": (n_out,)}
        shapes = {name: value.shape for name, value in self.weights.items()}
        shapes |= {"regressor_sd": self.regressor_sd.shape, "output_sd": self.output_sd.shape}
        for name in sorted(expected.keys() | shapes.keys()):
            if expected.get(name) != shapes.get(name):
                raise ModelError(
                    f"shape {shapes.get(name, 'missing')}",
                    where=name if name.endswith("_sd") else f"weights.{name}",
                    remedy=f"a network of kind {self.kind!r} with {n_z} regressors and {n_out} "
                    f"outputs has {expected.get(name, 'no such weights')}",
                )
        if self.kind == "polynomial":
            exponents = self.weights["exponents"]
            if not (np.all(exponents >= 0) and np.all(exponents == np.round(exponents))) or not (
                np.all(exponents.sum(axis=1) >= 1)
            ):
                raise ModelError(
                    "an exponent is no whole number, or a row is without any",
                    where="weights.exponents",
                    remedy="whole numbers from 0 on, one at least in each row",
                )
        elif self.kind != "mlp" and not np.all(self.weights["widths"] > 0):
            raise ModelError(
                "a width is not positive", where="weights.widths", remedy="train again"
            )


@dataclass(frozen=True)
class NarxStructure:
    """Which past samples a network predicts the next output from.

    The output at sample k is predicted from ``y(k − l)``, l in ``output_lags``, and ``u(k − m)``,
    m in ``input_lags``; ``u(k − 1)`` is the command that is held over the step that ends in
    ``y(k)``, so that a model in the form ``x⁺ = f(x, u)`` has it as its input. A structure with
    ``residual_lags`` predicts from past residuals too, ``e(k − l) = y(k − l) − ŷ(k − l)``
    (NNARMAX); one without ``output_lags`` from past commands alone (NNFIR).

    Raises ModelError for lags that do not rise from 1 on, units that are not one a signal, a sample
    time that is not positive.
    """

    outputs: tuple[str, ...]  #: Names of the signals
    inputs: tuple[str, ...]  #: Names of the signals
    output_units: tuple[str, ...]  #: One a signal
    input_units: tuple[str, ...]  #: One a signal
    output_lags: tuple[int, ...]  #: Rising, from 1 for an incremental network; empty: NNFIR
    input_lags: tuple[int, ...]  #: Rising, at least 1
    sample_time: float  #: s
    incremental: bool = True  #: The network gives ``y(k) − y(k − 1)``, else ``y(k)``
    #: After the most recent output the regressor has the differences between successive lags
    #: instead of the values: lagged values of a slow signal are nearly equal, and first-order
    #: training crawls along that valley
    differences: bool = True
    residual_lags: tuple[int, ...] = ()  #: Rising, at least 1; in a free run residuals are zero

    #: Left out of files where empty
    OPTIONAL: ClassVar[tuple[str, ...]] = ("residual_lags",)

    def __post_init__(self) -> None:
        for name in ("outputs", "inputs", "output_units", "input_units"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("output_lags", "input_lags", "residual_lags"):
            lags = tuple(getattr(self, name))
            object.__setattr__(self, name, lags)
            if not lags and name != "input_lags":
                continue
            if not lags or lags[0] < 1 or any(b <= a for a, b in pairwise(lags)):
                raise ModelError(
                    f"{list(lags)} given", where=name, remedy="rising whole numbers, from 1 on"
                )
        if self.incremental and self.output_lags[:1] != (1,):
            raise ModelError(
                f"{list(self.output_lags)} given",
                where="output_lags",
                remedy="a network of increments starts from lag 1",
            )
        if self.residual_lags and not self.output_lags:
            raise ModelError(
                "residuals without past outputs",
                where="residual_lags",
                remedy="give output_lags too, or leave residual_lags empty",
            )
        for what in ("output", "input"):
            if len(getattr(self, f"{what}_units")) != len(getattr(self, f"{what}s")):
                raise ModelError(
                    f"{len(getattr(self, f'{what}_units'))} given",
                    where=f"{what}_units",
                    remedy=f"one for each of {', '.join(getattr(self, f'{what}s'))}",
                )
        if not self.sample_time > 0:
            raise ModelError(
                f"{self.sample_time!r} given", where="sample_time", remedy="a positive time in s"
            )

    @property
    def n_regressors(self) -> int:
        outputs = len(self.outputs) * len(self.output_lags)
        return outputs + len(self.inputs) * len(self.input_lags) + self.n_residuals

    @property
    def n_predicted(self) -> int:
        """Outputs of the network."""
        return len(self.outputs)

    @property
    def n_residuals(self) -> int:
        """Past residuals among the regressors."""
        return len(self.outputs) * len(self.residual_lags)

    @property
    def longest_output_lag(self) -> int:
        """Past outputs that must be known, the present one among them; 1 where none is used."""
        return max(self.output_lags, default=1)

    @property
    def longest_lag(self) -> int:
        """Samples of the past that must be known before the first prediction."""
        return max(self.longest_output_lag, self.input_lags[-1], *self.residual_lags)

    def arrangement(self) -> FloatArray:
        """The regressor as a linear map of the lagged values, ``(n_phi, n_phi)``: φ = T lagged.

        ``lagged`` has the outputs lag by lag (all signals at the first lag, then all at the
        second, …), then the inputs likewise, then the residuals.
        """
        result = np.eye(self.n_regressors)
        if self.differences:
            n_y = len(self.outputs)
            for row in range(n_y, n_y * len(self.output_lags)):
                result[row, row - n_y] = 1.0
                result[row, row] = -1.0
        return result

    def to_data(self) -> dict[str, Any]:
        """Plain data for a YAML file."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in ((item.name, getattr(self, item.name)) for item in fields(self))
            if name != "residual_lags" or value
        }

    @classmethod
    def from_data(cls, data: Mapping[str, Any], where: str = "structure") -> NarxStructure:
        """The structure of :meth:`to_data`.

        Raises ModelError for a key that is missing or unknown and for values that do not fit; it
        names the key.
        """
        return from_plain_data(cls, data, where, "write it as trained")


def activated(activation: Activation, sums: FloatArray) -> FloatArray:
    """What hidden units give for their weighted sums, of any shape."""
    if activation == "tanh":
        return np.asarray(np.tanh(sums))
    if activation == "logistic":
        return np.asarray(0.5 * (1.0 + np.tanh(0.5 * sums)))
    if activation == "softplus":
        return np.asarray(np.logaddexp(0.0, sums))
    return sums


def _activation_expression(activation: Activation, sums: ca.SX) -> ca.SX:
    if activation == "tanh":
        return ca.tanh(sums)
    if activation == "logistic":
        return 0.5 * (1.0 + ca.tanh(0.5 * sums))
    if activation == "softplus":
        # log(1 + exp s), free of branches, so that each derivative is exact; for |s| < 1400
        return 0.5 * sums + ca.log(2.0 * ca.cosh(0.5 * sums))
    return sums


def squared_distances(points: FloatArray, centres: FloatArray) -> FloatArray:
    """Squared Euclidean distances, ``(n, n_z), (n_c, n_z) -> (n, n_c)``."""
    return np.asarray(np.sum((points[:, None, :] - centres[None, :, :]) ** 2, axis=2))


def from_plain_data(kind: type[T], data: Any, where: str, remedy: str) -> T:
    """A dataclass of plain data, whose complaints name the key.

    Raises ModelError for a key that is missing or unknown, and for values that do not fit.
    """
    # A field with a default of its own may be missing from files of before it.
    names = {item.name for item in fields(kind)}  # type: ignore[arg-type]
    optional = names & set(getattr(kind, "OPTIONAL", ()))
    check_keys(data, names - optional, where, optional)
    try:
        return kind(**data)
    except ModelError as error:
        raise ModelError(
            error.problem, where=f"{where}.{error.where}", remedy=error.remedy
        ) from None
    except TypeError as error:
        raise ModelError(
            f"a value of the wrong type ({error})", where=where, remedy=remedy
        ) from None


def check_keys(data: Any, expected: set[str], where: str, optional: Collection[str] = ()) -> None:
    """Refuse a mapping that lacks a key or has one more; it may have those of ``optional``.

    Raises ModelError: it names the key.
    """
    if not isinstance(data, Mapping):
        raise ModelError(f"{data!r} is no mapping", where=where, remedy="train again")
    for name in sorted(expected ^ (set(data) - set(optional)), key=str):
        word = "missing" if name in expected else "unknown"
        raise ModelError(
            f"key {word}", where=f"{where}.{name}", remedy=f"keys: {', '.join(sorted(expected))}"
        )


def _is_vector(name: str) -> bool:
    return name.startswith("b") or name == "widths"


def _array(value: Any, dimensions: int, where: str) -> FloatArray:
    try:
        result = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError("not an array of numbers", where=where, remedy="train again") from None
    if result.ndim != dimensions or not np.all(np.isfinite(result)):
        raise ModelError(
            "not finite" if result.ndim == dimensions else f"{result.ndim} dimensions",
            where=where,
            remedy=f"finite numbers in {dimensions} dimension(s)",
        )
    result.setflags(write=False)
    return result
