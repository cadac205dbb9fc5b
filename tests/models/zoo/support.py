"""The models of the zoo, small."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch

from benchnav.models.config import JoinedConfig
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.training import networks
from benchnav.models.training.best import KeepBest
from benchnav.models.training.check import Trainable
from benchnav.models.zoo.evidential import EvidentialConfig, EvidentialModel
from benchnav.models.zoo.mc_dropout import DropoutConfig, DropoutModel
from benchnav.models.zoo.mean_variance import MeanVarianceConfig, MeanVarianceModel
from benchnav.models.zoo.quantile import QuantileConfig, QuantileModel
from benchnav.models.zoo.swag import SWAGConfig, SWAGModel
from tests.models.support import scale

EXACT = {"precision": "32-true"}
SMALL: dict[str, Any] = {
    "encoder": "mobilenet_v2", "encoder_depth": 2, "hidden": 16, "max_epochs": 3, "batch_size": 5,
    "jitter": 0.2,
}  # fmt: skip
ZOO: dict[str, tuple[type[JoinedModel], JoinedConfig]] = {
    "mean_variance": (MeanVarianceModel, MeanVarianceConfig(**SMALL)),
    "quantile": (QuantileModel, QuantileConfig(**SMALL)),
    "evidential": (EvidentialModel, EvidentialConfig(**SMALL)),
    "mc_dropout": (DropoutModel, DropoutConfig(**SMALL, masks=5)),
    "swag": (SWAGModel, SWAGConfig(**SMALL, draws=3)),
}


def make(name: str, seed: int = 0, **changes: Any) -> Any:
    """Builds a model of the zoo with fresh weights."""
    kind, config = ZOO[name]
    scales = scale(torch.tensor([100.0, 90, 80]), torch.tensor([20.0, 25, 30]), 10.0)
    return kind(replace(config, **changes)).build(scales, seed=seed).eval()


def to_train(name: str, **changes: Any) -> Trainable:
    """A model of the zoo, to be trained."""
    kind, config = ZOO[name]
    return Trainable(
        kind=kind, config=replace(config, **changes), name=name, family=name
    )


class Killed(Exception):
    pass


@contextmanager
def killed_in(epoch: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ends a training in the midst of an epoch, counted from 0, as a kill would."""

    class Kill(KeepBest):
        def on_train_batch_end(self, trainer, *_: object) -> None:  # type: ignore[no-untyped-def, override]
            if trainer.current_epoch == epoch:
                raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(networks, "KeepBest", Kill)
        with pytest.raises(Killed):
            yield
