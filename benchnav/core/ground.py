"""Statistics of the training maps: the prior for unobserved terrain.

Letters in shapes: K components; H×W cells; *B any leading dimensions.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from benchnav.core.errors import ConfigError, expect
from benchnav.core.mixture import TraversabilityMixture

FORMAT = "benchnav-ground-1"
SEEN = "seen"
"""Layer of an observation that is 1 in observed cells and 0 in all other cells.

Only models that declare this layer as an input receive it.
"""


@dataclass(frozen=True, kw_only=True)
class GroundStatistics:
    """Statistics over all training maps.

    Args:
        weights: weights of the Gaussian mixture, clipped to [0, 1], that describes λ
            over all cells, K numbers.
        means: means of the mixture's components before clipping, K numbers.
        stds: standard deviations of the mixture's components before clipping, ≥ 0, K
            numbers.
        layer_means: mean of each channel by name of an `Observation`'s layer; `rgb` has
            three channels, in 0–255.
        look_alikes: pairs of names of look-alike classes.
        potts_strength: coupling β of the two-state random field of a pair's classes:
            the log odds that each of four neighbours adds to its class.
    """

    weights: tuple[float, ...]
    means: tuple[float, ...]
    stds: tuple[float, ...]
    layer_means: Mapping[str, tuple[float, ...]]
    look_alikes: tuple[tuple[str, str], ...] = ()
    potts_strength: float = 0.0

    def __post_init__(self) -> None:
        """Validate the mixture."""
        expect(
            len(self.weights) == len(self.means) == len(self.stds) > 0,
            "`weights`, `means` and `stds` of the same length > 0, got the lengths "
            f"{len(self.weights)}, {len(self.means)} and {len(self.stds)}.",
        )
        expect(
            min(self.weights) >= 0 and abs(sum(self.weights) - 1) < 1e-3,
            f"`weights` ≥ 0 that sum to 1, got {self.weights}.",
        )
        expect(min(self.stds) >= 0, f"`stds` ≥ 0, got {self.stds}.")

    def mixture(
        self, shape: Sequence[int], like: torch.Tensor
    ) -> TraversabilityMixture:
        """Return the mixture in each cell of maps.

        Args:
            shape: [*B, H, W].
            like: tensor whose dtype and device the result has.
        """
        *batch, height, width = shape
        maps = (*batch, len(self.weights), height, width)

        def expand(values: tuple[float, ...]) -> torch.Tensor:
            return like.new_tensor(values)[:, None, None].expand(maps)

        return TraversabilityMixture(
            expand(self.weights), expand(self.means), expand(self.stds)
        )

    def to_json(self) -> str:
        """Return the statistics as the text of a file."""
        return json.dumps({"format": FORMAT, **asdict(self)}, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "GroundStatistics":
        """Read statistics from the text of a file.

        Raises:
            ConfigError: If the text has another format or is damaged.
        """
        try:
            record: dict[str, Any] = json.loads(text)
            file_format = record.pop("format", None)
            expect(
                file_format == FORMAT,
                f"ground statistics of the format {FORMAT}, got the format "
                f"{file_format!r}. Create them again.",
            )
            layer_means = {
                name: tuple(values) for name, values in record["layer_means"].items()
            }
            statistics = cls(
                weights=tuple(record["weights"]),
                means=tuple(record["means"]),
                stds=tuple(record["stds"]),
                layer_means=layer_means,
                look_alikes=tuple((a, b) for a, b in record["look_alikes"]),
                potts_strength=record["potts_strength"],
            )
            channels = {name: len(values) for name, values in layer_means.items()}
            required = {"rgb": 3, "elevation_m": 1, "slope_deg": 1}
            expect(
                required.items() <= channels.items(),
                f"`layer_means` with the numbers of channels {required}, got "
                f"{channels}. Create the ground statistics again.",
            )
            return statistics
        except ConfigError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(
                "Expected ground statistics in the form that `benchnav-datagen ground` "
                f"writes, got {type(error).__name__}: {error}. Create them again."
            ) from error
