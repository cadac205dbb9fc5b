import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import load_recipe
from benchnav.models.quality.command import evaluate as evaluate_command
from benchnav.models.quality.look_alikes import LookAlikeQuality, LookAlikeTally
from benchnav.models.quality.measure import evaluate
from benchnav.models.quality.report import LOOK_ALIKES, quality_csv, quality_json, quality_markdown
from tests.models.stub import ColourModel

ALIKE = [(0, 2), (1,), (0, 2), (3,)]  # the first and the third of four classes


def tally(probabilities: Tensor, class_id: Tensor, alike: list[tuple[int, ...]] = ALIKE) -> LookAlikeQuality:
    """Of cells in a row: probabilities [N, C] and classes [N]."""
    counted = LookAlikeTally(alike, torch.device("cpu"))
    for part in torch.arange(len(class_id)).tensor_split(3):
        counted.add(probabilities[part].T[None, :, None], class_id[part][None, None])
    return counted.quality()


def drawn(cells: int, share: Tensor) -> Tensor:
    """Classes of cells that are the first of two with probability `share` [N], else the third."""
    first = torch.rand(cells, generator=torch.Generator().manual_seed(0)) < share
    return torch.where(first, 0, 2)


def test_what_is_right_but_for_look_alikes_is_right_when_they_are_merged() -> None:
    class_id = torch.tensor([0, 2, 0, 1, 3, 3])
    found = torch.tensor([2, 0, 0, 1, 3, 1])
    probabilities = torch.nn.functional.one_hot(found, 4).float()
    quality = tally(probabilities, class_id)
    assert quality.look_alike_accuracy == pytest.approx(5 / 6)
    # Intersection over union: look-alikes 3/3, the second 1/2, the fourth 1/2.
    assert quality.look_alike_miou == pytest.approx((1 + 1 / 2 + 1 / 2) / 3)


def test_look_alikes_that_together_weigh_most_are_found() -> None:
    quality = tally(torch.tensor([[0.3, 0.4, 0.3, 0.0]] * 6), torch.tensor([0, 2, 0, 2, 0, 2]))
    assert quality.look_alike_accuracy == 1


def test_of_two_look_alikes_one_half_each_is_right() -> None:
    share = torch.full((4000,), 0.5)
    class_id = drawn(4000, share)
    fair = torch.tensor([0.35, 0.2, 0.35, 0.1]).expand(4000, -1)
    quality = tally(fair, class_id)
    assert quality.look_alike_share_error == pytest.approx(0, abs=1e-6)
    assert quality.look_alike_share_ece < 0.03
    sure = torch.tensor([0.7, 0.2, 0.0, 0.1]).expand(4000, -1)
    quality = tally(sure, class_id)
    assert quality.look_alike_share_error == pytest.approx(0.5)
    assert quality.look_alike_share_ece == pytest.approx(0.5, abs=0.03)


def test_shares_other_than_one_half_may_be_calibrated() -> None:
    share = torch.where(torch.arange(20_000) % 2 == 0, 0.8, 0.3)
    class_id = drawn(20_000, share)
    told = torch.stack([0.6 * share, torch.full_like(share, 0.4), 0.6 * (1 - share), 0 * share], 1)
    quality = tally(told, class_id)
    assert quality.look_alike_share_ece < 0.02
    assert quality.look_alike_share_error == pytest.approx(0.25, abs=1e-5)
    assert quality.look_alike_accuracy == 1


def test_cells_of_other_classes_and_without_any_share_count_as_nothing_and_as_one_half() -> None:
    probabilities = torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.9, 0.1, 0.0, 0.0]])
    quality = tally(probabilities, torch.tensor([0, 1]))
    assert quality.look_alike_share_error == 0
    none = tally(probabilities, torch.tensor([1, 3]))
    assert math.isnan(none.look_alike_share_error)
    assert math.isnan(none.look_alike_share_ece)


def test_of_three_look_alikes_a_third_each_is_right() -> None:
    alike = [(0, 1, 2)] * 3
    probabilities = torch.full((9, 3), 1 / 3)
    quality = tally(probabilities, torch.arange(9) % 3, alike)
    assert quality.look_alike_share_error == pytest.approx(0, abs=1e-6)
    assert quality.look_alike_accuracy == 1


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    """Maps of ten classes of which the first four are of two colours."""
    recipe = load_recipe("tiny-v1")
    colours = [item.colour for item in recipe.classes]
    classes = tuple(
        replace(item, colour=colours[place // 2 if place < 4 else place])
        for place, item in enumerate(recipe.classes)
    )
    splits = {name: replace(recipe.splits[name], maps=2) for name in ("test/std", "test/hs")}
    path = tmp_path_factory.mktemp("look_alikes") / "look_alikes.h5"
    for _ in create(replace(recipe, classes=classes, splits=splits), path):
        pass
    return TerrainDataset(path)


def test_a_dataset_with_look_alikes_is_measured_with_them_merged(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = ColourModel()
    model.colours = torch.tensor([item.colour for item in dataset.recipe.classes]).float()
    qualities = dict(evaluate(model, dataset))
    (measured,) = qualities["test/std"].classes
    assert measured.look_alikes is not None
    assert measured.look_alikes.look_alike_accuracy > measured.accuracy
    assert measured.look_alikes.look_alike_share_error == pytest.approx(
        0, abs=1e-6
    )  # one colour, one probability
    row = json.loads(quality_json({}, qualities))["splits"]["test/std"]
    assert {name: row[name] for name in LOOK_ALIKES} == pytest.approx(vars(measured.look_alikes))
    assert f"{measured.look_alikes.look_alike_accuracy:.6g}" in quality_csv(qualities)
    page = quality_markdown("", qualities, [], [])
    assert "mIoU look-alikes=1" in page
    assert len({row.count("|") for row in page.splitlines() if row.startswith("|")}) == 1


def test_the_command_writes_and_draws_look_alikes(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(registry, "_REGISTERED", {})
    registry.register("model", "colours", ColourModel)
    evaluate_command("colours", str(dataset.path), out=str(tmp_path / "q"), maps=1)
    assert "look-alikes=1" in capfd.readouterr().out
    assert (tmp_path / "q" / "figures" / "confusion.png").is_file()
    assert "look-alikes=1" in (tmp_path / "q" / "quality.md").read_text()


def test_a_dataset_without_look_alikes_has_no_such_numbers(dataset: TerrainDataset, tmp_path: Path) -> None:
    plain = load_recipe("tiny-v1")
    splits = {"test/std": replace(plain.splits["test/std"], maps=1)}
    for _ in create(replace(plain, splits=splits), tmp_path / "plain.h5"):
        pass
    qualities = dict(evaluate(ColourModel(), TerrainDataset(tmp_path / "plain.h5")))
    assert qualities["test/std"].classes[0].look_alikes is None
    assert "look_alikes" not in quality_markdown("", qualities, [], [])
    assert not {*LOOK_ALIKES, "look_alikes"} & set(
        json.loads(quality_json({}, qualities))["splits"]["test/std"]
    )
    assert "look-alike" not in quality_csv(qualities)
