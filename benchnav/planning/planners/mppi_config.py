"""Settings of the MPPI planner."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from benchnav.core.errors import expect
from benchnav.planning.planners.planner import check_finite

_MIN_TAIL_FIELDS = 10  # minimum number of fields over whose costs the CVaR averages


@dataclass(frozen=True, kw_only=True)
class MPPIConfig:
    """Settings of MPPI; the defaults are this project's, since the paper has no values.

    Args:
        horizon_s: horizon in seconds; T is the nearest number of steps, at least 1.
        samples: number of action sequences K.
        noise_share: standard deviation of each action's noise, as a fraction of the
            range between the action's bounds; must be the default if `noise` is given.
        noise: standard deviation of each action's noise in the unit of the action, such
            as m/s and rad/s; None to use `noise_share`.
        temperature_share: temperature as a fraction of the spread of the costs
            (`cost_spread`) in each episode and step; must be the default if
            `temperature` is given.
        temperature: temperature in the units of J (λ in the source); None to use
            `temperature_share`.
        control_cost: weight γ ≥ 0 of the information-theoretic control cost γ·uᵀΣ⁻¹ε.
            With γ = 0, the base distribution is centred on the current mean (α = 1 in
            the source). With γ = `temperature`, it is centred on 0 (α = 0).
        risk_on: quantity whose risk is taken. `map`: λ of each cell, so that rollouts
            use λ̂. `cost`: the cost, so that rollouts use fields of λ.
        level: level α of the CVaR of the cost, in [0, 1); 0 for the mean.
        fields: number of fields M on which each sequence is rolled out. If α > 0, at
            least 10 / (1 − α), so that the CVaR averages at least 10 fields.
        once: whether fields are drawn once per predicted map, instead of at each step.
        entrapment: whether rollouts end on terrain that immobilises robots, at the cost
            of standing there for the remaining time.
        cost_to_go: terminal cost of a rollout. `objective`: the terminal cost of J.
            `map`: the cost of A*'s cheapest path to the goal under λ̂. `expected-time`:
            the cost of that path under λ̂ of the risk setting `expected-time`.
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
            expect(
                is_valid,
                f"`noise` > 0 and finite for each action of MPPI, got {self.noise}.",
            )
        for name in ("noise", "temperature"):
            value = getattr(self, name)
            fraction = getattr(self, f"{name}_share")
            default = getattr(type(self), f"{name}_share")
            expect(
                value is None or fraction == default,
                f"only one of `{name}` and `{name}_share` for MPPI, got "
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
            "`risk_on` 'cost' for MPPI with `level`, `fields` or `once`, got 'map'. "
            "Set `risk_on` to 'cost', or omit these settings.",
        )
        choices = "objective", "map", "expected-time"
        expect(
            self.cost_to_go in choices,
            f"`cost_to_go` among {', '.join(choices)} for MPPI, got {self.cost_to_go!r}.",
        )
        min_fields = math.ceil(_MIN_TAIL_FIELDS / (1 - self.level) - 1e-9)
        expect(
            self.level == 0 or self.fields >= min_fields,
            f"`fields` of at least {_MIN_TAIL_FIELDS} / (1 − `level`) = {min_fields} "
            f"for MPPI, got {self.fields}.",
        )
