"""Export of a model as one ONNX graph: network, predicted parameters, mean and CVaR.

A robot runs the graph with ONNX Runtime only, without PyTorch. Letters in shapes: B
maps, H×W cells.
"""

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from benchnav.core.batch import map_tensors
from benchnav.core.distribution import TraversabilityDistribution, tail_of
from benchnav.core.errors import ConfigError, expect, out_of_memory_error, quiet
from benchnav.core.grid import Grid
from benchnav.core.pooled import pool
from benchnav.core.settings import one_line
from benchnav.core.store import replacing
from benchnav.core.terrain import Observation
from benchnav.models.base import TraversabilityModel
from benchnav.models.fused import FusedModel
from benchnav.models.nets.ensemble import Ensemble, widened
from benchnav.models.nets.trainable import TrainableModel, in_single_precision
from benchnav.models.onnx_distributions import cvar_of, mean_of, parameters_of

_TOLERANCE = 1e-5  # relative to the model's own predictions
_EXAMPLE_SHAPE = (2, 48, 40)  # B, H, W of the maps that trace and check a graph


class Graph(nn.Module):
    """The exported function: from layers of maps to parameters, mean and CVaR.

    Attributes `input_names` and `output_names` name its inputs and outputs in order.

    Args:
        model: model rebuilt from a checkpoint.
        level: level α of the CVaR, in [0, 1).

    Raises:
        ConfigError: If the model cannot be exported, or the level is outside [0, 1).
    """

    def __init__(self, model: TraversabilityModel, level: float) -> None:
        """Collect the networks of the model."""
        super().__init__()
        self.model = model
        self.tail = tail_of(level)
        if isinstance(model, FusedModel):
            members: Sequence[Any] = model.classifiers
        elif isinstance(model, Ensemble | TrainableModel):
            members = getattr(model, "members", (model,))
        else:
            raise ConfigError(
                "Expected a fused model or a benchnav.models.TrainableModel to export, "
                f"got {type(model).__name__}. Export it with custom code."
            )
        self.networks = nn.ModuleList(members)
        layers: list[str] = []
        for member in members:
            expect(
                not member.no_graph,
                f"a model that can be exported to ONNX, got {type(member).__name__}, "
                f"which {member.no_graph}.",
            )
            layers += member.inputs
        if isinstance(model, FusedModel):
            layers.append("slope_deg")
        self.input_names = tuple(dict.fromkeys(layers))
        self.output_names: tuple[str, ...] = ()
        self.eval().requires_grad_(False).cpu()

    def predict(self, maps: dict[str, Tensor]) -> TraversabilityDistribution:
        """Return the model's prediction from layers by name."""
        if isinstance(self.model, FusedModel):
            members = [member(maps).float().softmax(1) for member in self.networks]
            return self.model.fuse_at(torch.stack(members), maps["slope_deg"])
        distributions = []
        for network in self.networks:
            member: Any = network
            raw = member.to_distribution(in_single_precision(member(maps)))
            distributions.append(member.sharpen(raw))
        pooled = pool(distributions)
        if isinstance(self.model, Ensemble):
            return widened(pooled, self.model.temperature)
        return pooled

    def forward(self, *layers: Tensor) -> tuple[Tensor, ...]:
        """Predict B maps.

        Args:
            layers: layers of the maps, in the order of `input_names`.

        Returns:
            Outputs, in the order of `output_names`.
        """
        n_maps = layers[0].shape[0]
        height, width = layers[0].shape[-2:]
        maps = dict(zip(self.input_names, layers, strict=True))
        # Padding and cropping make sizes symbolic expressions, with which each further
        # operation would be slow to export.
        predicted = map_tensors(
            self.predict(maps),
            lambda values: values.reshape(n_maps, *values.shape[1:-2], height, width),
        )
        outputs = parameters_of(predicted)
        outputs["mean"] = mean_of(predicted)
        outputs["cvar"] = cvar_of(predicted, self.tail)
        self.output_names = tuple(outputs)
        return tuple(value.float() for value in outputs.values())


def export_onnx(
    model: TraversabilityModel,
    path: str | Path,
    name: str,
    level: float = 0.9,
    opset: int = 18,
) -> Graph:
    """Write a model as an ONNX graph for maps of any number and size.

    Args:
        model: model rebuilt from a checkpoint.
        path: output file.
        name: name of the model, stored in the file.
        level: level α of the CVaR, in [0, 1).
        opset: version of ONNX's operators.

    Returns:
        The exported graph.

    Raises:
        ConfigError: If the model cannot be exported, `opset` is out of range, or the
            packages of the extra `onnx` are missing.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  torch.onnx needs it
    except ImportError as error:
        raise ConfigError(
            "Expected the packages of the extra `onnx` to be installed, got none. Run: "
            "pip install 'benchnav[onnx]'."
        ) from error
    newest = onnx.defs.onnx_opset_version()
    expect(
        18 <= opset <= newest,
        f"`opset` from 18 to {newest}, which torch.onnx can write, got {opset}.",
    )
    graph = Graph(model, level)
    layers = _check_graph(graph, model)
    n_maps, height, width = map(torch.export.Dim, ("batch", "height", "width"))
    colour_sizes = {0: n_maps, 2: height, 3: width}
    layer_sizes = {0: n_maps, 1: height, 2: width}
    sizes = [colour_sizes if layer.ndim == 4 else layer_sizes for layer in layers]
    try:
        with (
            quiet("torch.onnx", "onnxscript"),
            warnings.catch_warnings(action="ignore"),
            torch.inference_mode(False),
            torch.no_grad(),
        ):
            program = torch.onnx.export(
                graph,
                tuple(layers),
                dynamo=True,
                opset_version=opset,
                verbose=False,
                input_names=list(graph.input_names),
                output_names=list(graph.output_names),
                dynamic_shapes=(tuple(sizes),),
            )
    except Exception as error:  # torch.onnx raises errors of many types
        raise out_of_memory_error(error) or ConfigError(
            "Expected a network that PyTorch can write as ONNX, got "
            f"{type(model).__name__}: {one_line(error.__cause__ or error)[:300]}"
        ) from error
    assert program is not None
    metadata = {
        "model": name,
        "class_names": list(model.class_names),
        "cvar_level": level,
        "temperature": getattr(model, "temperature", 1.0),
    }
    program.model.metadata_props["benchnav"] = json.dumps(metadata)
    with replacing(Path(path)) as partial:
        program.save(partial)
    return graph


def _check_graph(graph: Graph, model: TraversabilityModel) -> list[Tensor]:
    """Compare a graph with its model on random maps.

    Returns:
        The layers of the random maps, in the order of `graph.input_names`.

    Raises:
        ConfigError: If the predictions differ because the model's `predict` does more
            than its hooks.
    """
    n_maps, height, width = _EXAMPLE_SHAPE
    generator = torch.Generator().manual_seed(0)
    rgb = torch.randint(
        0, 256, (n_maps, 3, height, width), generator=generator, dtype=torch.uint8
    )
    others = {
        name: 30 * torch.rand(n_maps, height, width, generator=generator)
        for name in graph.input_names
        if name != "rgb"
    }
    flat = torch.zeros(n_maps, height, width)
    fields = {"elevation_m": flat, "slope_deg": flat, **others}
    observation = Observation(
        rgb=rgb,
        elevation_m=fields.pop("elevation_m"),
        slope_deg=fields.pop("slope_deg"),
        grid=Grid(height, width, 1.0),
        layers=fields,
    )
    maps = {"rgb": rgb, **others}
    layers = [maps[name] for name in graph.input_names]
    with torch.no_grad():
        mean, cvar = graph(*layers)[-2:]
        predicted = model.predict(observation)
    mean_error = (mean - predicted.mean()).abs().max()
    cvar_error = (cvar - predicted.cvar(1 - graph.tail)).abs().max()
    error = max(float(mean_error), float(cvar_error))
    expect(
        error < _TOLERANCE,
        "a model whose `predict` uses only its network and `to_distribution`, got "
        f"{type(model).__name__}, whose exported graph differs from `predict` by up to "
        f"{error:.2g}. Move all other computation into the network or "
        "`to_distribution`.",
    )
    return layers
