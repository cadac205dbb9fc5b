"""A model as one ONNX graph: its network, the parameters of what it predicts, and their
mean and CVaR.

A robot runs the graph with ONNX Runtime alone, without PyTorch. With F the distribution
function of λ, v the VaR, which 40 halvings of [0, 1] find, and p = 1 − α the tail,

    E[λ] = 1 − ∫₀¹ F,    CVaR_α = v − 1/p ∫₀^v F   (see `benchnav.core.cvar`).

The integral of a mixture is of closed form, also where members are averaged. Where a
temperature T widens a distribution to Φ(Φ⁻¹(F) / T), Gauss-Legendre quadrature is used
between nodes about each component.
Letters in shapes: B maps, H×W cells, K components, E nodes.
"""

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from benchnav.core.batch import map_tensors
from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.distribution import TraversabilityDistribution, tail_of
from benchnav.core.errors import ConfigError, expect, out_of_memory, quiet
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import PooledDistribution, pool
from benchnav.core.quantiles import QuantileDistribution
from benchnav.core.settings import one_line
from benchnav.core.store import replacing
from benchnav.core.terrain import Observation
from benchnav.models.base import TraversabilityModel
from benchnav.models.fused import FusedModel
from benchnav.models.nets.trainable import (
    Ensemble,
    TrainableModel,
    in_single_precision,
    widened,
)

_HALVINGS = 40
_NEAR = 1e-5  # of what the model itself predicts
_SMALLEST_STD = 1e-9
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_REACHES = (0.35, 1.0, 1.75, 2.5, 3.5, 5.0, 8.0, 14.0)
_EDGES = (*_REACHES, *(-reach for reach in _REACHES))  # standard deviations
_FARTHEST, _LEAST_SHARE = 37.0, 1e-300  # beyond which Φ is no normal number
_HART_END = 7.07106781186547
_HART_ABOVE = (
    3.52624965998911e-02, 0.700383064443688, 6.37396220353165, 33.912866078383, 112.079291497871, 221.213596169931,
    220.206867912376,
)  # fmt: skip
_HART_BELOW = (
    8.83883476483184e-02, 1.75566716318264, 16.064177579207, 86.7807322029461, 296.564248779674, 637.333633378831,
    793.826512519948, 440.413735824752,
)  # fmt: skip
_ACKLAM_A = (
    -3.969683028665376e01, 2.209460984245205e02, -2.759285104469687e02, 1.383577518672690e02, -3.066479806614716e01,
    2.506628277459239,
)  # fmt: skip
_ACKLAM_B = (
    -5.447609879822406e01, 1.615858368580409e02, -1.556989798598866e02, 6.680131188771972e01, -1.328068155288572e01,
    1.0,
)  # fmt: skip
_ACKLAM_C = (
    -7.784894002430293e-03, -3.223964580411365e-01, -2.400758277161838, -2.549732539343734, 4.374664141464968,
    2.938163982698783,
)  # fmt: skip
_ACKLAM_D = (
    7.784695709041462e-03,
    3.224671290700398e-01,
    2.445134137142996,
    3.754408661907416,
    1.0,
)
_TRIED = (2, 48, 40)  # B, H, W of the maps that a graph is traced and tried on


class Graph(nn.Module):
    """What is exported: from layers of maps to parameters, mean and CVaR.

    Args:
        model: rebuilt from a checkpoint.
        level: α of the CVaR.

    Raises:
        ConfigError: such a model has no graph, or the level is outside [0, 1).
    """

    def __init__(self, model: TraversabilityModel, level: float) -> None:
        """Keeps the networks."""
        super().__init__()
        self.model, self.tail = model, tail_of(level)
        if isinstance(model, FusedModel):
            members: Sequence[Any] = model.classifiers
        elif isinstance(model, Ensemble | TrainableModel):
            members = getattr(model, "members", (model,))
        else:
            raise ConfigError(
                "Expected a fused model or a benchnav.models.TrainableModel to "
                "export, got "
                f"{type(model).__name__}. Export it by code of your own."
            )
        self.networks = nn.ModuleList(members)
        for member in members:
            lacks = member.no_graph
            expect(
                not lacks,
                f"a model that ONNX can hold to export, got {type(member).__name__}, "
                f"which {lacks}.",
            )
        slope = ("slope_deg",) if isinstance(model, FusedModel) else ()
        layers = (name for member in members for name in member.inputs)
        self.layers = tuple(dict.fromkeys((*layers, *slope)))
        self.names: tuple[str, ...] = ()
        self.eval().requires_grad_(False).cpu()

    def predict(self, maps: dict[str, Tensor]) -> TraversabilityDistribution:
        """As the model's own `predict`, of layers by name."""
        if isinstance(self.model, FusedModel):
            members = torch.stack(
                [member(maps).float().softmax(1) for member in self.networks]
            )
            return self.model.fuse_at(members, maps["slope_deg"])
        pooled = pool([
            member.sharpen(member.to_distribution(in_single_precision(member(maps))))  # type: ignore[operator]
            for member in self.networks
        ])  # fmt: skip
        return (
            widened(pooled, self.model.temperature)
            if isinstance(self.model, Ensemble)
            else pooled
        )

    def forward(self, *layers: Tensor) -> tuple[Tensor, ...]:
        """Predicts B maps, given by layer in the order of `layers`; outputs in the
        order of `names`.
        """
        batch, (height, width) = layers[0].shape[0], layers[0].shape[-2:]
        # Of sizes that padding and cropping have made, expressions as they are, each
        # operation would be slow to write.
        predicted = map_tensors(
            self.predict(dict(zip(self.layers, layers, strict=True))),
            lambda values: values.reshape(batch, *values.shape[1:-2], height, width),
        )
        found = parameters_of(predicted)
        found["mean"], found["cvar"] = mean_of(predicted), cvar_of(predicted, self.tail)
        self.names = tuple(found)
        return tuple(value.float() for value in found.values())


def parameters_of(
    distribution: TraversabilityDistribution, prefix: str = ""
) -> dict[str, Tensor]:
    """The parameters by name; of members that do not make one mixture
    `member_1_weights`, ….

    Raises:
        ConfigError: it is of a class of which no graph is made.
    """
    if isinstance(distribution, TraversabilityMixture):
        return {
            f"{prefix}{name}": getattr(distribution, name)
            for name in ("weights", "means", "stds")
        }
    if isinstance(distribution, QuantileDistribution):
        return {f"{prefix}quantiles": distribution.values}
    if isinstance(distribution, ConditionedDistribution):
        return parameters_of(distribution.base, prefix)
    if isinstance(distribution, PooledDistribution):
        found: dict[str, Tensor] = {}
        for number, member in enumerate(distribution.members, 1):
            found |= parameters_of(member, f"{prefix}member_{number}_")
        return found
    raise ConfigError(
        "Expected a model that predicts a TraversabilityMixture or a "
        "QuantileDistribution to export, got one of "
        f"{type(distribution).__name__}."
    )


def mean_of(distribution: TraversabilityDistribution) -> Tensor:
    """E[λ], shape [B, H, W]."""
    if isinstance(distribution, QuantileDistribution):
        return distribution.mean()
    ones = torch.ones_like(_first(distribution), dtype=torch.float64)
    return (1 - _integral(distribution, ones)).clamp(0, 1)


def cvar_of(distribution: TraversabilityDistribution, tail: float) -> Tensor:
    """The mean of λ over its lowest share `tail`, shape [B, H, W]."""
    if tail == 1:
        return mean_of(distribution)
    if isinstance(distribution, QuantileDistribution):
        return distribution.cvar(1 - tail)
    share = torch.full_like(_first(distribution), tail, dtype=torch.float64)
    value = _quantile(distribution, share)
    return (value - _integral(distribution, value) / tail).clamp(min=0).minimum(value)


def _quantile(distribution: TraversabilityDistribution, share: Tensor) -> Tensor:
    """Least λ that is not exceeded with probabilities, shape [B, H, W]."""
    if isinstance(distribution, ConditionedDistribution):
        score = (
            distribution.score_mean
            + distribution.score_std.double() * _normal_score(share)
        )
        return _quantile(distribution.base, _normal_cdf(score))
    # Each operation of a halving is written 40 times: what can be is computed before.
    if isinstance(distribution, TraversabilityMixture):
        weights, means, stds = _mixture(distribution)
        # Φ = ½ (1 + erf)
        scale, sought = (
            math.sqrt(0.5) / stds,
            (2 * share - 1).unsqueeze(1),
        )

        def reached(value: Tensor) -> Tensor:
            # which is ONNX's own
            erf = torch.erf(((value - means) * scale).float()).double()
            return (weights * erf).sum(1, keepdim=True) >= sought

    else:

        def reached(value: Tensor) -> Tensor:
            return _tails(distribution, value[:, 0])[0].unsqueeze(1) >= share.unsqueeze(
                1
            )

    low = torch.zeros_like(share).unsqueeze(1)
    for halving in range(1, _HALVINGS + 1):
        middle = low + 0.5**halving
        low = torch.where(reached(middle), low, middle)
    return low[:, 0] + 0.5**_HALVINGS


def _first(distribution: TraversabilityDistribution) -> Tensor:
    """Any layer of the distribution's shape, [B, H, W]."""
    return next(iter(parameters_of(distribution).values()))[:, 0]


def _mixture(mixture: TraversabilityMixture) -> tuple[Tensor, Tensor, Tensor]:
    """Weights that sum to 1, means and standard deviations, in float64."""
    weights = mixture.weights.double()
    stds = mixture.stds.double().clamp(min=_SMALLEST_STD)
    return weights / weights.sum(1, keepdim=True), mixture.means.double(), stds


def _tails(distribution: TraversabilityDistribution, value: Tensor) -> Tensor:
    """P(λ ≤ value) and P(λ > value), each to its own last digits, shape [2, *E, B, H,
    W].
    """
    if isinstance(distribution, PooledDistribution):
        return _average([_tails(member, value) for member in distribution.members])
    if isinstance(distribution, ConditionedDistribution):
        tails = _tails(distribution.base, value)
        scores = _normal_score(tails)
        prior = torch.where(tails[0] < tails[1], scores[0], -scores[1])
        score = (prior - distribution.score_mean) / distribution.score_std.double()
        return _normal_cdf(torch.stack([score, -score]))
    if isinstance(distribution, QuantileDistribution):
        below = distribution.cdf(value).double()
        return torch.stack([below, 1 - below])
    assert isinstance(distribution, TraversabilityMixture)
    weights, means, stds = _mixture(distribution)
    z = (value.unsqueeze(-3) - means) / stds
    return (weights * _normal_cdf(torch.stack([z, -z]))).sum(-3)


def _integral(distribution: TraversabilityDistribution, value: Tensor) -> Tensor:
    """∫ of F from 0 to values in [0, 1], shape [B, H, W]."""
    if isinstance(distribution, PooledDistribution):
        return _average([_integral(member, value) for member in distribution.members])
    if isinstance(distribution, TraversabilityMixture):
        weights, means, stds = _mixture(distribution)
        z = torch.stack([-means, value.unsqueeze(1) - means]) / stds
        # ∫ of Φ up to z
        below = z * _normal_cdf(z) + torch.exp(-z * z / 2) / math.sqrt(2 * math.pi)
        return (weights * stds * (below[1] - below[0])).sum(1)
    edges = _edges(distribution, value)
    low, width = edges[:-1], edges[1:] - edges[:-1]
    # All nodes at once: a graph of few large operations, which is quicker to write and
    # to run.
    nodes, weights = (
        torch.from_numpy(values).view(-1, 1, 1, 1, 1) / 2
        for values in (_NODES, _WEIGHTS)
    )
    heights = _tails(distribution, low + (0.5 + nodes) * width)[0]
    return (weights * width * heights).flatten(0, 1).sum(0)


def _edges(distribution: TraversabilityDistribution, value: Tensor) -> Tensor:
    """Ends of intervals over which F is smooth, about each component; shape [E, B, H,
    W].
    """
    found = parameters_of(distribution)
    edges = [torch.stack([torch.zeros_like(value), value])]
    steps = torch.tensor(_EDGES, dtype=torch.float64).view(-1, 1, 1, 1, 1)
    for name in found:
        if name.endswith("means"):
            means, stds = (
                found[name].double(),
                found[name.removesuffix("means") + "stds"].double(),
            )
            edges.append((means + steps * stds).movedim(2, 1).flatten(0, 1))
    return torch.cat(edges).clamp(min=0).minimum(value).sort(0).values


def _average(values: Sequence[Tensor]) -> Tensor:
    return torch.stack(list(values)).mean(0)


def _normal_cdf(z: Tensor) -> Tensor:
    """Φ in float64 to 10⁻⁷ of itself, also far below 0.

    Source: Hart's approximation as of West (2005), "Better approximations to cumulative
    normal functions".
    """
    x = z.abs().clamp(max=_FARTHEST)
    beyond = x + 0.65
    for count in (4, 3, 2, 1):
        beyond = x + count / beyond
    share = torch.where(
        x < _HART_END,
        _polynomial(x, _HART_ABOVE) / _polynomial(x, _HART_BELOW),
        1 / beyond / math.sqrt(2 * math.pi),
    )
    lower = share * torch.exp(-0.5 * x * x)
    return torch.where(z > 0, 1 - lower, lower)


def _normal_score(share: Tensor) -> Tensor:
    """Φ⁻¹, which ONNX has not, to 10⁻⁸ of itself.

    Source: Acklam (2003), "An algorithm for computing the inverse normal cumulative
    distribution function".
    """
    share = share.clamp(_LEAST_SHARE, 1 - 2**-53)
    centre = share - 0.5
    square = centre * centre
    middle = centre * _polynomial(square, _ACKLAM_A) / _polynomial(square, _ACKLAM_B)
    outer = (-2 * share.minimum(1 - share).log()).sqrt()
    below = _polynomial(outer, _ACKLAM_C) / _polynomial(outer, _ACKLAM_D)
    return torch.where(
        centre.abs() < 0.47575, middle, torch.where(centre < 0, below, -below)
    )


def _polynomial(x: Tensor, coefficients: Sequence[float]) -> Tensor:
    """Its value by Horner's scheme, coefficients from the highest power."""
    total = torch.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        total = total * x + coefficient
    return total


def export_onnx(
    model: TraversabilityModel,
    path: str | Path,
    about: str,
    level: float = 0.9,
    opset: int = 18,
) -> Graph:
    """Writes a model as an ONNX graph for maps of any number and size.

    Args:
        model: rebuilt from a checkpoint.
        path: file to write.
        about: what the model is called, kept in the file.
        level: α of the CVaR, in [0, 1).
        opset: version of ONNX's operators.

    Returns:
        What was exported, with the names of its inputs, `layers`, and of its outputs,
        `names`.

    Raises:
        ConfigError: such a model has no graph, or the packages of the extra `onnx` are
            missing.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  torch.onnx needs it
    except ImportError as error:
        raise ConfigError(
            "Expected the packages of the extra `onnx`, got none. Install them: pip "
            "install 'benchnav[onnx]'."
        ) from error
    newest = onnx.defs.onnx_opset_version()
    expect(
        18 <= opset <= newest,
        f"`opset` in 18–{newest}, which torch.onnx writes, got {opset}.",
    )
    layers = _tried(graph := Graph(model, level), model)
    batch, height, width = (
        torch.export.Dim(name) for name in ("batch", "height", "width")
    )
    sizes = [
        {0: batch, 2: height, 3: width}
        if layer.ndim == 4
        else {0: batch, 1: height, 2: width}
        for layer in layers
    ]
    try:
        with (
            quiet("torch.onnx", "onnxscript"), warnings.catch_warnings(action="ignore"),
            torch.inference_mode(False), torch.no_grad(),
        ):  # fmt: skip
            program = torch.onnx.export(
                graph, tuple(layers), dynamo=True, opset_version=opset, verbose=False,
                input_names=list(graph.layers), output_names=list(graph.names), dynamic_shapes=(tuple(sizes),),
            )  # fmt: skip
    except Exception as error:  # of many kinds
        raise out_of_memory(error) or ConfigError(
            "Expected a network that PyTorch writes as ONNX, got "
            f"{type(model).__name__}: "
            f"{one_line(error.__cause__ or error)[:300]}"
        ) from error
    assert program is not None
    program.model.metadata_props["benchnav"] = json.dumps(
        _described(graph, model, about, level)
    )
    with replacing(Path(path)) as partial:
        program.save(partial)
    return graph


def _tried(graph: Graph, model: TraversabilityModel) -> list[Tensor]:
    """Tries the graph on random maps, which are given back by layer.

    Raises:
        ConfigError: it does not predict as the model does, whose `predict` does more
            than its hooks say.
    """
    count, height, width = _TRIED
    generator = torch.Generator().manual_seed(0)
    rgb = torch.randint(
        0, 256, (count, 3, height, width), generator=generator, dtype=torch.uint8
    )
    others = {
        name: 30 * torch.rand(count, height, width, generator=generator)
        for name in graph.layers
        if name != "rgb"
    }
    maps = {"rgb": rgb, **others}
    flat = torch.zeros(count, height, width)
    known = {"elevation_m": flat, "slope_deg": flat, **others}
    observation = Observation(
        rgb=rgb, elevation_m=known.pop("elevation_m"), slope_deg=known.pop("slope_deg"),
        grid=Grid(height, width, 1.0), layers=known,
    )  # fmt: skip
    layers = [maps[name] for name in graph.layers]
    with torch.no_grad():
        found, own = (
            dict(zip(("mean", "cvar"), graph(*layers)[-2:], strict=True)),
            model.predict(observation),
        )
    off = max(
        float((found["mean"] - own.mean()).abs().max()),
        float((found["cvar"] - own.cvar(1 - graph.tail)).abs().max()),
    )
    expect(
        off < _NEAR,
        "a model whose `predict` is its network and `to_distribution` alone, got "
        f"{type(model).__name__}, of which the "
        f"graph is off by {off:.2g}.",
    )
    return layers


def _described(
    graph: Graph, model: TraversabilityModel, about: str, level: float
) -> dict[str, Any]:
    """What a user has to know beside the graph."""
    return {
        "model": about,
        "class_names": list(model.class_names),
        "cvar_level": level,
        "temperature": getattr(model, "temperature", 1.0),
    }
