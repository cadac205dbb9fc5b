"""Settings of MPPI."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from benchnav.core.errors import expect
from benchnav.planning.planners.planner import check_finite

_MIN_TAIL = 10  # minimum number of fields in the tail of the cost


@dataclass(frozen=True, kw_only=True)
class MPPIConfig:
    """Settings of MPPI. The defaults are ours, since the paper states no values.

    Args:
        horizon_s: horizon in seconds; T is the nearest number of steps, at least 1.
        samples: number of action sequences K.
        noise_share: standard deviation of each sampled action, as a fraction of the
            range between its bounds; rejected together with `noise`.
        noise: standard deviation of each sampled action in its unit, such as m/s and
            rad/s, instead of `noise_share`.
        temperature_share: temperature as a fraction of the spread of costs
            (`cost_spread`) of the episode and step; rejected together with
            `temperature`.
        temperature: temperature in the units of J, instead of `temperature_share`; λ in
            the source.
        control_cost: weight γ of the information-theoretic control cost γ·uᵀΣ⁻¹ε. At 0
            the mean of the base distribution is the current mean (α = 1 in the source);
            at the value of `temperature` it is 0 (α = 0).
        risk_on: maps of the rollouts. `map`: λ̂; `cost`: fields of λ, with λ̂ only in the
            free mask, if the rules use it.
        level: α of the CVaR of the cost, in [0, 1); 0 for the mean.
        fields: number of fields M for each sequence; if α > 0, at least 10 in the tail,
            M ≥ 10 / (1 − α).
        once: whether fields are drawn once per predicted map, instead of at each step.
        entrapment: whether rollouts stop for good on terrain that immobilises robots.
        cost_to_go: terminal cost of a rollout. `objective`: terminal cost of J; `map`:
            cost of A*'s cheapest path to the goal under λ̂; `expected-time`: cost of
            that path under the λ̂ of the risk setting `expected-time`.
    """

    added: ClassVar = ("risk_on", "level", "fields", "once", "entrapment", "cost_to_go")

    horizon_s: float = 5.0
    samples: int = 5000
    noise_share: float = 0.5
    noise: tuple[float, ...] | None = None
    temperature_share: float = 0.1
    temperature: float | None = None
    control_cost: float = 0.0
    risk_on: Literal["map", "cost"] = "map"
    level: float = 0.0
    fields: int = 64
    once: bool = False
    entrapment: bool = False
    cost_to_go: str = "objective"

    def __post_init__(self) -> None:
        """Validate the settings."""
        above_zero = (
            "horizon_s",
            "samples",
            "noise_share",
            "temperature_share",
            "temperature",
            "fields",
        )
        check_finite("MPPI", self, above_zero, ("control_cost",))
        if self.noise is not None:
            is_valid = self.noise and all(0 < scale < math.inf for scale in self.noise)
            expect(is_valid, f"`noise` > 0 for each action of MPPI, got {self.noise}.")
        for name in ("noise", "temperature"):
            value = getattr(self, name)
            fraction = getattr(self, f"{name}_share")
            default = getattr(type(self), f"{name}_share")
            expect(
                value is None or fraction == default,
                f"`{name}` or `{name}_share` for MPPI, got both, "
                f"{value} and {fraction}. Omit one of them.",
            )
        expect(
            self.risk_on in ("map", "cost"),
            f"`risk_on` 'map' or 'cost' for MPPI, got {self.risk_on!r}.",
        )
        expect(0 <= self.level < 1, f"`level` in [0, 1) for MPPI, got {self.level}.")
        has_default_fields = self.fields == MPPIConfig.fields
        is_default = self.level == 0 and not self.once and has_default_fields
        expect(
            self.risk_on == "cost" or is_default,
            "`risk_on: cost` for `level`, `fields` and `once` of MPPI, got 'map', "
            "for which the risk setting decides.",
        )
        choices = "objective", "map", "expected-time"
        expect(
            self.cost_to_go in choices,
            f"`cost_to_go` among {', '.join(choices)} for MPPI, got {self.cost_to_go!r}.",
        )
        min_fields = math.ceil(_MIN_TAIL / (1 - self.level) - 1e-9)
        expect(
            self.level == 0 or self.fields >= min_fields,
            f"`fields` of at least {_MIN_TAIL} / (1 − `level`) = {min_fields} for MPPI, "
            f"got {self.fields}.",
        )
