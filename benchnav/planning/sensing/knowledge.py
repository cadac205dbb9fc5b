"""Knowledge of robots about their maps: observations, belief, λ̂ and free mask.

A belief that learns receives measured λ at each step. At some steps the appearance
sensor is used as well, the model predicts again if more was observed, and the belief is
updated. A `Learner` contains the parts that do this, and a `Knowledge` the current
state. Only sensors receive the `Truth`.
Letters in shapes: B episodes, S state dimensions, H×W cells, N cells of all maps
together.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch, find_tensor_fault
from benchnav.core.device import GPU_FAULTS
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.settings import fault
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning.sensing.appearance import Memory
from benchnav.planning.sensing.sensor import Measurement
from benchnav.planning.world.outcome import Outcome

_PESSIMISTIC = 0.8  # level of the CVaR that is assumed for unobserved terrain

Result = TypeVar("Result")


class KnowledgeError(BenchnavError):
    """Failure of a sensor, belief, model or risk measure during an episode.

    `__cause__` is the original exception, `outcome` the outcome of the episodes.
    """

    def __init__(self, message: str, outcome: Outcome) -> None:
        """Store the message and the outcome of the episodes."""
        super().__init__(message)
        self.outcome = outcome


@dataclass(frozen=True, kw_only=True)
class Truth(Batch):
    """True state of the episodes; only sensors receive it.

    Args:
        terrain: the true maps, B of them.
        field: current λ of all cells, shape [B, H, W].
        keys: a stream key of the sensors' noise for each of B episodes.
    """

    terrain: Terrain
    field: Tensor
    keys: tuple[int, ...]

    def select(self, members: Tensor) -> "Truth":
        """Return some episodes, by index, int64."""
        keys = tuple(self.keys[index] for index in members.tolist())
        return replace(super().select(members), keys=keys)

    def put(self, members: Tensor, others: "Truth") -> "Truth":
        """Replace episodes, by index, int64."""
        keys = list(self.keys)
        for index, key in zip(members.tolist(), others.keys, strict=True):
            keys[index] = key
        return replace(super().put(members, others), keys=tuple(keys))


@dataclass(frozen=True, kw_only=True)
class Knowledge(Batch):
    """Knowledge in B episodes.

    Args:
        memory: observed appearance; None if the whole map was observed at the start.
        has_news: mask of episodes with new or less noisy observations that the
            prediction does not include, bool, shape [B].
        sensed: measured λ since the last update; the last measurement of each cell.
        ever_sensed: mask of cells with measured λ, bool, shape [B, H, W].
        footprint: mask of cells observed in the last step, bool, shape [B, H, W].
        observation: input of the model.
        belief_state: state of the belief.
        risk_map: λ̂, shape [B, H, W].
        spread: spread of the belief (`TraversabilityDistribution.spread`), shape
            [B, H, W]; None if it is not stored.
        free: free mask, to which the area at the goal is not added, bool, [B, H, W].
    """

    memory: Memory | None
    has_news: Tensor
    sensed: Measurement
    ever_sensed: Tensor
    footprint: Tensor
    observation: Observation
    belief_state: Any
    risk_map: Tensor
    spread: Tensor | None
    free: Tensor

    @property
    def seen(self) -> Tensor:
        """Mask of observed cells, bool, shape [B, H, W]."""
        if self.memory is None:
            return torch.ones_like(self.free)
        return self.memory.seen


def unseen_ground(
    statistics: GroundStatistics, unseen: str, shape: torch.Size, like: Tensor
) -> TraversabilityMixture:
    """Return the λ assumed for unobserved terrain.

    Args:
        statistics: statistics of the training maps.
        unseen: option of `Rules`.
        shape: [B, H, W].
        like: tensor of the dtype and device.
    """
    prior = statistics.mixture(shape, like)
    if unseen == "prior":
        return prior
    value = 1.0
    if unseen == "pessimistic":
        single_cell = statistics.mixture((1, 1, 1), like.double())
        value = float(single_cell.cvar(_PESSIMISTIC))
    means = torch.full_like(prior.means[:, :1], value)
    return TraversabilityMixture(torch.ones_like(means), means, torch.zeros_like(means))


def nothing_sensed(like: Tensor) -> Measurement:
    """Return a measurement without λ, shape [B, H, W]."""
    unmeasured = torch.full_like(like, torch.nan)
    return Measurement(traversability=unmeasured, std=torch.ones_like(unmeasured))


def sensor_keys(noise_key: int, maps: Any) -> tuple[int, ...]:
    """Return stream keys of the sensors' noise.

    Args:
        noise_key: root key of a world's noise.
        maps: indices of the maps of the episodes.
    """
    return tuple(rng.stream_key(noise_key, "sensor", int(index)) for index in maps)


def check_map(name: str, values: Any, dtype: torch.dtype, like: Tensor) -> None:
    """Check a tensor's dtype, shape and device."""
    fault_text = find_tensor_fault(name, values, dtype, tuple(like.shape), like.device)
    if fault_text:
        raise ConfigError(fault_text)


def call(outcome: Outcome, work: Callable[[], Result]) -> Result:
    """Call user code; convert its exceptions.

    Raises:
        KnowledgeError: If `work` fails; the episodes end with this outcome.
    """
    try:
        return work()
    except GPU_FAULTS:
        raise
    except (Exception, SystemExit) as error:
        raise KnowledgeError(fault(error), outcome) from error
