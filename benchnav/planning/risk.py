"""Risk settings: from the distribution of traversability to the one map a planner sees.

A setting is written `name` or `name:level`: `cvar:0.9`, `var:0.95`, `mean`, `single-class`. Risk
means the lower tail of λ; a higher level is more cautious. Source: paper II and III-B.
"""

from dataclasses import dataclass

from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.mixture import TraversabilityMixture

NAMES = ("cvar", "var", "mean", "single-class")


@dataclass(frozen=True)
class RiskSetting:
    """How a distribution becomes a number.

    Args:
        name: `cvar`, `var`, `mean`, or `single-class`, the CVaR of the most likely class alone.
        level: α in [0, 1); `mean` has none.
    """

    name: str
    level: float = 0.9

    def __post_init__(self) -> None:
        """Refuses unknown names and levels."""
        if self.name not in NAMES:
            raise ConfigError(f"Expected a risk setting among {', '.join(NAMES)}, got {self.name!r}.")
        if not 0 <= self.level < 1:
            raise ConfigError(
                f"Expected the level of risk setting {self.name!r} in [0, 1), got {self.level}."
            )

    @classmethod
    def parse(cls, text: str) -> "RiskSetting":
        """Reads `name` or `name:level`.

        Raises:
            ConfigError: it is neither.
        """
        name, colon, level = text.partition(":")
        if not colon:
            return cls(name)
        if name == "mean":
            raise ConfigError(f"Expected risk setting 'mean' without a level, got {text!r}.")
        try:
            return cls(name, float(level))
        except ValueError as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"Expected risk setting `name:level` with a number, got {text!r}.") from error

    def apply(self, mixture: TraversabilityMixture) -> Tensor:
        """Infers the map λ̂ that a planner is given.

        Args:
            mixture: distribution a cell, shape [B, K, H, W].

        Returns:
            λ̂ in [0, 1], shape [B, H, W].
        """
        match self.name:
            case "cvar":
                return mixture.cvar(self.level)
            case "var":
                return mixture.var(self.level)
            case "mean":
                return mixture.mean()
            case _:
                return mixture.most_likely().cvar(self.level)
