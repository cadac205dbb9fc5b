import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav.core.device import CPU
from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.terrain import Observation
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import layer_means
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.base import predict_observation
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.config import (
    ClassifierConfig,
    LatentGPConfig,
    Masking,
    MDNConfig,
    TrainOptions,
    plain_config,
)
from benchnav.models.predictor import load_model
from benchnav.models.training.data import Loading, MapData, MapDataset
from benchnav.models.training.fit import FitOptions
from benchnav.models.training.masks import RandomMasks, path_distances
from benchnav.models.training.networks import classifier_of, fit_network, train_networks
from tests.models.support import trainable

FIELDS = ("rgb", "seen", "elevation_m", "slope_deg", "class_id", "traversability")
QUIET = Masking(share=1.0, radius_m=(3.0, 3.0), colour_noise=0.0, elevation_noise=0.0)
MASKED = ClassifierConfig(
    inputs=("rgb", "seen"),
    encoder_depth=2,
    max_epochs=2,
    batch_size=5,
    masking=Masking(share=0.7),
)


def masks(dataset: TerrainDataset, masking: Masking) -> RandomMasks:
    return RandomMasks(
        masking=masking,
        means=layer_means(dataset),
        resolution_m=dataset.grid.resolution_m,
    )


def looks(count: int, **fixed: float) -> Tensor:
    """Random looks, some of their numbers fixed by name."""
    drawn = torch.rand(
        count, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    names = ("masked", "radius", "x0", "y0", "x1", "y1", "driven", "noise")
    for name, value in fixed.items():
        drawn[:, names.index(name)] = value
    return drawn


def valid(dataset: TerrainDataset) -> dict[str, Tensor]:
    return MapDataset(dataset.path, "valid", FIELDS).read(range(4))


def test_cells_near_a_straight_path_are_those_near_any_of_its_points() -> None:
    path = looks(5)[:, 2:7]
    found = path_distances(path, (12, 20), 0.5)
    y, x = (np.arange(size) * 0.5 + 0.25 for size in (12, 20))
    for place, (x0, y0, x1, y1, driven) in enumerate(path.tolist()):
        at = np.linspace(0, driven, 2001)
        along_x, along_y = 10 * (x0 + at * (x1 - x0)), 6 * (y0 + at * (y1 - y0))
        every = np.hypot(x[None, :, None] - along_x, y[:, None, None] - along_y).min(-1)
        np.testing.assert_allclose(found[place], every, atol=5e-3)


def test_what_is_not_seen_is_the_training_mean_and_is_not_learned(
    dataset: TerrainDataset,
) -> None:
    maps, how = valid(dataset), masks(dataset, QUIET)
    masked = how.apply(maps, looks(4))
    seen = masked["seen"] == 1
    assert 0.02 < seen.float().mean() < 0.9
    assert torch.equal(seen, path_distances(looks(4)[:, 2:7], (32, 32), 0.5) <= 3)
    for name, unknown in (
        ("elevation_m", how.means["elevation_m"][0]),
        ("class_id", UNLABELLED),
    ):
        assert torch.equal(masked[name][seen], maps[name][seen])
        assert bool((masked[name][~seen] == unknown).all())
        assert masked[name].dtype == maps[name].dtype
    assert torch.equal(masked["traversability"][seen], maps["traversability"][seen])
    assert bool(masked["traversability"][~seen].isnan().all())
    colours = masked["rgb"].movedim(1, -1)
    assert torch.equal(colours[seen], maps["rgb"].movedim(1, -1)[seen])
    assert colours[~seen].unique(dim=0).tolist() == [
        [round(value) for value in how.means["rgb"]]
    ]


def test_a_slope_is_known_where_the_cell_and_all_its_neighbours_were_seen(
    dataset: TerrainDataset,
) -> None:
    maps, how = valid(dataset), masks(dataset, QUIET)
    masked = how.apply(maps, looks(4))
    seen, mean = (
        np.pad(
            masked["seen"].numpy() == 1, ((0, 0), (1, 1), (1, 1)), constant_values=True
        ),
        how.means["slope_deg"],
    )
    whole = np.ones((4, 32, 32), bool)
    for row in range(3):
        for column in range(3):
            whole &= seen[:, row : row + 32, column : column + 32]
    assert 0 < whole.mean() < (masked["seen"] == 1).float().mean()
    np.testing.assert_allclose(
        masked["slope_deg"][whole], maps["slope_deg"][whole], atol=2e-3
    )
    assert bool((masked["slope_deg"][~torch.from_numpy(whole)] == mean[0]).all())


@pytest.mark.parametrize(
    ("name", "noise"),
    [("rgb", {"colour_noise": 4.0}), ("elevation_m", {"elevation_noise": 0.3})],
)
def test_noise_grows_with_the_distance_to_the_path(
    dataset: TerrainDataset, name: str, noise: dict[str, float]
) -> None:
    law = replace(QUIET, radius_m=(8.0, 8.0), **noise)
    maps = {
        field: values.repeat(16, *[1] * (values.ndim - 1))
        for field, values in valid(dataset).items()
    }
    maps["rgb"] = torch.full_like(maps["rgb"], 128)
    look = looks(64, x0=0.5, y0=0.5, driven=1e-6)
    masked = masks(dataset, law).apply(maps, look)
    distance = path_distances(look[:, 2:7], (32, 32), 0.5)
    off = (masked[name].double() - maps[name].double()) / next(iter(noise.values()))
    off = off if name == "elevation_m" else off[:, 1]
    for near, far in ((1, 2), (4, 5), (6, 7)):
        ring = (distance > near) & (distance <= far)
        rounding = 1 / 12 / 16 if name == "rgb" else 0.0
        assert off[ring].square().mean() == pytest.approx(
            float(distance[ring].square().mean()) + rounding, rel=0.05
        )
        assert abs(float(off[ring].mean())) < 0.05 * far
    other = "elevation_m" if name == "rgb" else "rgb"
    seen = masked["seen"] == 1
    assert torch.equal(
        *(
            of[other].movedim(1, -1)[seen] if other == "rgb" else of[other][seen]
            for of in (masked, maps)
        )
    )


def test_slopes_are_those_of_the_elevation_that_was_seen(
    dataset: TerrainDataset,
) -> None:
    maps = {**valid(dataset), "elevation_m": torch.zeros(4, 32, 32)}
    law = replace(QUIET, radius_m=(50.0, 50.0), elevation_noise=0.002)
    slopes = masks(dataset, law).apply(maps, looks(4, x0=0.5, y0=0.5, driven=1e-6))[
        "slope_deg"
    ]
    # By Horn's method noise of σ gives each gradient the variance 12 σ² / (8 res)².
    away = path_distances(looks(4, x0=0.5, y0=0.5, driven=1e-6)[:, 2:7], (32, 32), 0.5)
    ring = (away > 5) & (away <= 6)
    wanted = 2 * 12 * (0.002 * 5.5) ** 2 / (8 * 0.5) ** 2
    assert torch.deg2rad(slopes[ring]).tan().square().mean() == pytest.approx(
        wanted, rel=0.15
    )


def test_a_share_of_the_maps_is_masked_by_radii_between_the_two(
    dataset: TerrainDataset,
) -> None:
    maps = {
        name: values[:1].expand(400, *values.shape[1:])
        for name, values in valid(dataset).items()
    }
    law = replace(QUIET, share=0.25, radius_m=(2.0, 8.0), colour_noise=9.0)
    look = looks(400, driven=1e-6, x0=0.5, y0=0.5)
    masked = masks(dataset, law).apply(maps, look)
    whole = (masked["seen"] == 1).all((1, 2))
    assert (~whole).float().mean() == pytest.approx(0.25, abs=0.06)
    assert torch.equal(masked["rgb"][whole], maps["rgb"][whole])  # nor is there noise
    assert torch.equal(masked["slope_deg"][whole], maps["slope_deg"][whole])
    radius = (masked["seen"][~whole].sum((1, 2)) * 0.25 / np.pi).sqrt()
    assert 1.9 < radius.min() < 2.6
    assert 6.8 < radius.max() < 8.1
    assert radius.log().median().exp() == pytest.approx(4, rel=0.15)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"share": 1.1}, "share"),
        ({"radius_m": (4.0, 2.0)}, "radius_m"),
        ({"radius_m": (0.0, 2.0)}, "radius_m"),
        ({"colour_noise": -1.0}, "colour_noise"),
        ({"elevation_noise": float("inf")}, "elevation_noise"),
    ],
)
def test_masks_that_are_none_are_refused(change: dict[str, object], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        Masking(**change)  # type: ignore[arg-type]


def test_training_maps_are_masked_anew_each_epoch_and_valid_maps_alike(
    dataset: TerrainDataset,
) -> None:
    law = masks(dataset, Masking(share=0.9))
    fields = ("rgb", "slope_deg", "seen", "class_id")
    data, workers = (
        MapData(dataset, 3, 5, fields, masks=law, loading=Loading(workers=workers))
        for workers in (0, 1)
    )
    loader = data.train_dataloader()
    epochs = []
    for epoch in (0, 1, 0):
        loader.sampler.set_epoch(epoch)  # type: ignore[attr-defined]
        epochs.append(torch.cat([batch["seen"].mean((1, 2)) for batch in loader]))
    assert torch.equal(epochs[0], epochs[2])
    assert not torch.equal(epochs[0], epochs[1])
    read = [
        torch.cat([batch["rgb"] for batch in one.val_dataloader()])
        for one in (data, workers)
    ]
    chunks = torch.cat([batch["rgb"] for _, batch in data.valid.chunks()])
    assert torch.equal(read[0], read[1])
    assert torch.equal(read[0], chunks)
    # what was read for slopes alone is left out
    assert set(next(iter(loader))) == set(fields)
    other = MapData(dataset, 3, 6, fields, masks=law).valid
    assert not torch.equal(
        chunks, torch.cat([batch["rgb"] for _, batch in other.chunks()])
    )


def test_without_masks_all_is_seen_and_settings_are_as_before(
    dataset: TerrainDataset,
) -> None:
    plain, told = (
        MapData(dataset, 3, 0, fields)
        for fields in (("rgb", "class_id"), ("rgb", "seen", "class_id"))
    )
    for one, two in zip(plain.train_dataloader(), told.train_dataloader(), strict=True):
        assert torch.equal(one["rgb"], two["rgb"])
        assert bool((two["seen"] == 1).all())
    assert "masking" not in plain_config(ClassifierConfig())
    assert plain_config(MASKED)["masking"]["share"] == 0.7
    scale = told.scale(("rgb", "seen"))
    assert [value.tolist() for value in scale["seen"]] == [[0], [1], 1]


def test_the_layer_seen_needs_masks(dataset: TerrainDataset, tmp_path: Path) -> None:
    told = classifier_of(replace(MASKED, masking=Masking()))
    with pytest.raises(ConfigError, match=r"`masking\.share` > 0"):
        train_networks(
            TrainOptions(device="cpu"), str(dataset.path), str(tmp_path / "c"), told
        )


def test_a_masked_training_is_kept_gone_on_with_and_told_from_others(
    dataset: TerrainDataset, tmp_path: Path
) -> None:
    out, how = (
        str(tmp_path / "c"),
        TrainOptions(device="cpu", trainer={"precision": "32-true"}),
    )
    gp = LatentGPConfig(epochs=1, epoch_steps=5)
    train_networks(how, str(dataset.path), out, classifier_of(MASKED), gp)
    part = load_checkpoint(out).part("classifier")
    assert json.loads(json.dumps(part.config["masking"]))["radius_m"] == [2.0, 16.0]
    assert part.config["inputs"] == ["rgb", "seen"]
    again = replace(how, resume=True)
    train_networks(again, str(dataset.path), out, classifier_of(MASKED), gp)
    for other in (
        replace(MASKED, masking=Masking(share=0.5)),
        replace(MASKED, inputs=("rgb",), masking=Masking()),
    ):
        with pytest.raises(CheckpointError, match=r"another .*`masking`"):
            train_networks(again, str(dataset.path), out, classifier_of(other), gp)
    model = load_model(out)
    whole = dataset.terrain("test/std", [0]).observe()
    unseen = torch.zeros_like(whole.elevation_m)
    given = [
        predict_observation(model, replace(whole, layers=layers)).mean()
        for layers in ({}, {"seen": unseen + 1}, {"seen": unseen})
    ]
    assert torch.equal(given[0], given[1])
    assert not torch.equal(given[0], given[2])


def test_networks_and_the_pool_of_them_meet_masked_maps(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exact = {"precision": "32-true", "max_epochs": 1}
    met: list[MapDataset] = []

    def spy(
        self: MapDataset, device: torch.device = CPU
    ) -> Iterator[tuple[range, dict[str, Tensor]]]:
        met.append(self)
        return chunks(self, device)

    chunks = MapDataset.chunks
    monkeypatch.setattr(MapDataset, "chunks", spy)
    read = MapDataset.__getitem__
    monkeypatch.setattr(
        MapDataset, "__getitem__", lambda self, key: met.append(self) or read(self, key)
    )
    how = TrainOptions(device="cpu", trainer=exact)
    train_networks(
        how, str(dataset.path), str(tmp_path / "c"), classifier_of(MASKED), members=2
    )
    laws = [maps.masks.masking if maps.masks else None for maps in met]
    assert {maps.split for maps in met} == {"train", "valid"}
    assert laws == [MASKED.masking] * len(met)


def test_any_trainable_model_learns_from_masked_maps(dataset: TerrainDataset) -> None:
    config = MDNConfig(
        inputs=("rgb", "slope_deg", "seen"), encoder_depth=1, hidden=4, max_epochs=1, batch_size=5,
        masking=Masking(share=1.0, radius_m=(0.01, 0.02)),
    )  # fmt: skip
    # Of most maps nothing at all is seen.
    network, metrics = fit_network(
        trainable(config),
        dataset,
        0,
        FitOptions(device="cpu", trainer={"precision": "32-true"}),
    )
    assert all(
        bool(values.isfinite().all()) for values in network.state_dict().values()
    )
    assert np.isfinite(metrics["train_loss"])


def test_a_model_that_does_not_declare_the_layer_never_sees_it(
    checkpoint_path: Path, dataset: TerrainDataset
) -> None:
    whole = dataset.terrain("test/std", [0]).observe()
    hidden: Observation = replace(
        whole, layers={"seen": torch.zeros_like(whole.elevation_m)}
    )
    one, two = (
        predict_observation(load_model(checkpoint_path), maps).mean()
        for maps in (whole, hidden)
    )
    assert torch.equal(one, two)
