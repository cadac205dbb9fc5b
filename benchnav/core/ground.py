"""What is known of ground before any of it is seen: statistics of the training maps.

Letters in shapes: K components, H×W cells, *B any leading dimensions.
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
"""Layer of an observation that is 1 where a cell was seen and 0 elsewhere, for models
that declare it as an input.
"""


@dataclass(frozen=True, kw_only=True)
class GroundStatistics:
    """Statistics of all training maps together.

    Args:
        weights: of the Gaussian mixture of λ, clipped to [0, 1], over all cells, K
            numbers.
        means: of its components, before clipping.
        stds: of its components, before clipping.
        layer_means: mean of each channel of each layer of an `Observation`, by the
            layer's name; of `rgb` three, 0–255.
        look_alikes: pairs of classes of one colour, by their names.
        potts_strength: β of the two-state random field over which of a pair's classes a
            cell is of: the log odds that a neighbour (of four) of one class adds.
    """

    weights: tuple[float, ...]
    means: tuple[float, ...]
    stds: tuple[float, ...]
    layer_means: Mapping[str, tuple[float, ...]]
    look_alikes: tuple[tuple[str, str], ...] = ()
    potts_strength: float = 0.0

    def __post_init__(self) -> None:
        """Refuses mixtures that are none."""
        expect(
            len(self.weights) == len(self.means) == len(self.stds) > 0,
            "as many `weights` as `means` and `stds`, got "
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
        """The mixture in each cell of maps.

        Args:
            shape: [*B, H, W].
            like: gives dtype and device.
        """
        *batch, height, width = shape
        weights, means, stds = (
            like.new_tensor(values)[:, None, None].expand(
                *batch, len(values), height, width
            )
            for values in (self.weights, self.means, self.stds)
        )
        return TraversabilityMixture(weights, means, stds)

    def to_json(self) -> str:
        """As the text of a file."""
        return json.dumps({"format": FORMAT, **asdict(self)}, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "GroundStatistics":
        """Reads what `to_json` wrote.

        Raises:
            ConfigError: it is of another format, or damaged.
        """
        try:
            about: dict[str, Any] = json.loads(text)
            found = about.pop("format", None)
            expect(
                found == FORMAT,
                f"ground statistics of the format {FORMAT}, got {found!r}.",
            )
            made = cls(
                weights=tuple(about["weights"]),
                means=tuple(about["means"]),
                stds=tuple(about["stds"]),
                layer_means={
                    name: tuple(values) for name, values in about["layer_means"].items()
                },
                look_alikes=tuple((one, other) for one, other in about["look_alikes"]),
                potts_strength=about["potts_strength"],
            )
            channels = {name: len(values) for name, values in made.layer_means.items()}
            wanted = {"rgb": 3, "elevation_m": 1, "slope_deg": 1}
            expect(
                wanted.items() <= channels.items(),
                f"`layer_means` of so many channels: {wanted}, got {channels}.",
            )
            return made
        except ConfigError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(
                "Expected ground statistics as `benchnav-datagen ground` writes "
                f"them, got {type(error).__name__} "
                f"{error}. Make them again."
            ) from error
