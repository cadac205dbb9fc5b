import hashlib
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from benchnav.core import part_lookup, registry
from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation, Terrain
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models import fused
from benchnav.models.base import TraversabilityModel, layers_of, predict
from benchnav.models.checkpoint import (
    Checkpoint,
    Part,
    digests_of,
    load_checkpoint,
    save_checkpoint,
)
from benchnav.models.config import MDNConfig
from benchnav.models.fused import FusedModel
from benchnav.models.nets.mdn import MixtureDensityModel
from benchnav.models.predictor import (
    Clairvoyant,
    Ideal,
    Oracle,
    class_mismatch,
    find_ground_statistics,
    load_model,
    nugget_of,
    open_checkpoint,
)
from tests.models.support import NAMES, linear_table, make_terrain


class Fixed(nn.Module):
    """A classifier that gives the same probabilities everywhere."""

    def __init__(self, *probabilities: float) -> None:
        super().__init__()
        self.logits = torch.tensor(probabilities).log().view(1, -1, 1, 1)

    def forward(self, maps: Mapping[str, Tensor]) -> Tensor:
        rgb = maps["rgb"]
        return self.logits.expand(len(rgb), -1, *rgb.shape[-2:])


class Spy(TraversabilityModel):
    """A user's own model; remembers what it was given."""

    def __init__(self) -> None:
        self.given: list[object] = []

    def predict(self, observation: Observation) -> TraversabilityMixture:
        self.given.append(observation)
        ones = torch.ones(len(observation.rgb), 1, *observation.grid.shape)
        return TraversabilityMixture(ones, 0.5 * ones, 0.1 * ones)


class Measured(Spy):
    """A model with an option."""

    def __init__(self, mean: float) -> None:
        super().__init__()
        self.mean = mean


def test_one_hot_probabilities_give_the_gp_of_that_class() -> None:
    terrain = make_terrain()
    model = FusedModel([Fixed(1.0, 1e-30, 1e-30)], linear_table(), NAMES)
    mixture = model.predict(terrain.observe())
    expected = TraversabilityMixture(
        torch.ones(2, 1, 16, 16),
        (1 - terrain.slope_deg / 90)[:, None],
        torch.full((2, 1, 16, 16), 0.1),
    )
    for level in (0.0, 0.9):
        torch.testing.assert_close(
            mixture.cvar(level), expected.cvar(level), rtol=0, atol=1e-5
        )


def test_the_mixture_is_equation_one() -> None:
    terrain = make_terrain()
    mixture = FusedModel([Fixed(0.5, 0.3, 0.2)], linear_table(), NAMES).predict(
        terrain.observe()
    )
    share = terrain.slope_deg / 90
    parts = [
        (0.5, 1 - share, 0.1),
        (0.3, torch.full_like(share, 0.5), 0.2),
        (0.2, share, 0.3),
    ]
    for value in (0.2, 0.7):
        by_hand = sum(p * torch.special.ndtr((value - m) / s) for p, m, s in parts)
        torch.testing.assert_close(mixture.cdf(value), by_hand, rtol=0, atol=1e-5)
    assert all(
        t.dtype == torch.float32 for t in (mixture.weights, mixture.means, mixture.stds)
    )


def test_single_class_is_the_gp_of_the_most_likely_class() -> None:
    mixture = FusedModel([Fixed(0.3, 0.5, 0.2)], linear_table(), NAMES).predict(
        make_terrain().observe()
    )
    single = mixture.most_likely()
    torch.testing.assert_close(single.means, torch.full((2, 1, 16, 16), 0.5))
    torch.testing.assert_close(single.stds, torch.full((2, 1, 16, 16), 0.2))


def test_chunks_change_nothing_and_the_result_is_no_inference_tensor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Bright(nn.Module):
        def forward(self, maps: Mapping[str, Tensor]) -> Tensor:
            return maps["rgb"].float() / 100

    terrain = make_terrain(batch=5)
    model = FusedModel([Bright()], linear_table(), NAMES)
    whole = model.predict(terrain.observe())
    monkeypatch.setattr(fused, "CHUNK_CELLS", 2 * 16 * 16)
    pieces = model.predict(terrain.observe())
    assert torch.equal(whole.weights, pieces.weights)
    assert not any(
        t.is_inference() for t in (pieces.weights, pieces.means, pieces.stds)
    )


def test_a_model_is_given_an_observation_and_the_oracle_alone_the_terrain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terrain, spy = make_terrain(), Spy()
    predict(spy, terrain)
    assert [type(given) for given in spy.given] == [Observation]

    given: list[object] = []
    answer = Oracle.predict_terrain

    def remember(self: Oracle, terrain: Terrain) -> TraversabilityMixture:
        given.append(terrain)
        return answer(self, terrain)

    monkeypatch.setattr(Oracle, "predict_terrain", remember)
    mixture = predict(load_model("oracle"), terrain)
    assert given == [terrain]
    assert torch.equal(mixture.means, terrain.truth.means)
    assert torch.equal(mixture.stds, terrain.truth.stds)
    assert torch.equal(mixture.weights, torch.ones_like(mixture.weights))


def test_a_prediction_that_does_not_fit_the_maps_is_refused() -> None:
    class Small(Spy):
        def predict(self, observation: Observation) -> TraversabilityMixture:
            ones = torch.ones(1, 1, 4, 4)
            return TraversabilityMixture(ones, ones, ones)

    with pytest.raises(
        ConfigError,
        match=r"shape \[2, 16, 16\], got TraversabilityMixture of shape \[1, 4, 4\]",
    ):
        predict(Small(), make_terrain())


MINE = """
import torch
from benchnav.core.mixture import TraversabilityMixture
from benchnav.models import ModelFamily, TraversabilityModel


class Constant(TraversabilityModel):
    def __init__(self, mean: float = 0.5, std: float = 0.1) -> None:
        self.mean, self.std = mean, std

    def predict(self, observation):
        ones = torch.ones_like(observation.slope_deg).unsqueeze(1)
        return TraversabilityMixture(ones, self.mean * ones, self.std * ones)


class Family(ModelFamily):
    @classmethod
    def from_checkpoint(cls, checkpoint):
        raise RuntimeError("ran what a checkpoint names")


class Nothing:
    pass
"""


@pytest.fixture
def _own_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("mine_of_tests.py").write_text(MINE)


def test_a_registered_model_is_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})
    registry.register("model", "mine", Spy)
    assert isinstance(load_model("mine"), Spy)
    registry.register("model", "made", lambda mean=0.5: Measured(mean))
    assert load_model("made:0.25").mean == 0.25  # type: ignore[attr-defined]


@pytest.mark.usefixtures("_own_file")
@pytest.mark.parametrize("place", ["./mine_of_tests.py", "mine_of_tests"])
def test_a_model_is_found_by_file_or_module_with_its_options(place: str) -> None:
    terrain = make_terrain()
    for source, mean, std in (
        (f"{place}:Constant", 0.5, 0.1),
        (f"{place}:Constant:0.25", 0.25, 0.1),
        ({"part": f"{place}:Constant", "options": {"std": 0.75}}, 0.5, 0.75),
        (registry.read_part("model", f"{place}:Constant:0.25"), 0.25, 0.1),
    ):
        mixture = predict(load_model(source), terrain)
        assert torch.equal(mixture.means, torch.full((2, 1, 16, 16), mean))
        assert torch.equal(mixture.stds, torch.full((2, 1, 16, 16), std))


@pytest.mark.usefixtures("_own_file")
def test_a_model_whose_training_was_interrupted_is_told_with_the_command_to_go_on(
    checkpoint_path: Path,
) -> None:
    whole = load_checkpoint(checkpoint_path)
    half = replace(whole, parts={"gp": whole.part("gp")})
    save_checkpoint("checkpoints/killed", half)
    with pytest.raises(CheckpointError, match="a part 'classifier'"):
        load_model("killed")
    for folder in (
        "killed.training/classifier",
        "first.training/mdn",
        "own.training/Mine-2",
        "whole.training/classifier",
    ):
        Path("checkpoints", folder).mkdir(parents=True)
    for source, command in (
        ("killed", "all --data DATA --out checkpoints/killed --resume"),
        ("checkpoints/killed/", "all --data DATA --out checkpoints/killed --resume"),
        ("first", "fit mdn --data DATA --out checkpoints/first --resume"),
        ("own", "fit path/to/file.py:Mine --data DATA --out checkpoints/own --resume"),
    ):
        with pytest.raises(CheckpointError, match="training was interrupted") as caught:
            load_model(source)
        assert f"`benchnav-train {command}`" in str(caught.value)
    save_checkpoint("checkpoints/mdn", replace(whole, model="mdn"))
    with pytest.raises(
        ConfigError,
        match="Give a checkpoint of this family by its path: checkpoints/mdn",
    ):
        load_model("mdn")
    # A finished training has left its logs; a member that joins an ensemble may still
    # be trained.
    Path("checkpoints/whole.training/classifier-2").mkdir()
    save_checkpoint("checkpoints/whole", whole)
    assert isinstance(load_model("whole"), FusedModel)


@pytest.mark.usefixtures("_own_file")
@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("oracel", "Did you mean 'oracle'?"),
        ("./mine_of_tests.py:Constnat", "Did you mean 'Constant'?"),
        (
            "./mine_of_tests.py:Constant:much",
            "of model './mine_of_tests.py:Constant' as a number, got 'much'",
        ),
        ("./mine_of_tests.py:Family", "which is a family of models"),
        (
            "./mine_of_tests.py:Nothing",
            "to be an instance of benchnav.models.TraversabilityModel, got Nothing. Write class Nothing(Tr",
        ),
        ("./mine_of_tests.py", "Name a class or function in the file"),
        ("oracle:3", "This model has no options"),
        ("checkpoints/papr-v1", "Did you mean 'paper-v1'?"),
        ("papr-v1", "Did you mean 'paper-v1'?"),
        ("checkpoints/minn", "Did you mean 'checkpoints/mine'?"),
        ("./elsewhere/thiers", "Did you mean 'elsewhere/theirs'?"),
        ("nothing/like/it", "Expected a model among"),
    ],
)
def test_what_is_no_model_gets_a_hint(
    source: str, expected: str, checkpoint_path: Path
) -> None:
    for folder in ("checkpoints/mine", "elsewhere/theirs"):
        Path(folder).parent.mkdir()
        Path(folder).symlink_to(checkpoint_path)
    with pytest.raises(ConfigError) as caught:
        load_model(source)
    assert expected in str(caught.value)


@pytest.mark.usefixtures("_own_file")
def test_a_checkpoint_runs_no_code_that_it_names(checkpoint_path: Path) -> None:
    Path("hostile_of_tests.py").write_text(MINE)
    for name in ("./hostile_of_tests.py:Family", "hostile_of_tests:Family", "oracle"):
        with pytest.raises(CheckpointError, match="Install the package"):
            open_checkpoint(replace(load_checkpoint(checkpoint_path), model=name))
    assert not [name for name in sys.modules if "hostile_of_tests" in name]


def test_a_checkpoint_has_no_options(checkpoint_path: Path) -> None:
    given = {"part": str(checkpoint_path), "label": "ours"}
    assert isinstance(load_model(given), FusedModel)
    with pytest.raises(ConfigError, match="no options"):
        load_model({**given, "options": {"level": 1}})


def test_the_digests_of_a_checkpoint_change_with_its_files(
    checkpoint_path: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(checkpoint_path, tmp_path / "copy"))
    before = digests_of(copy)
    assert set(before) == {"config.json", "classifier.safetensors", "gp.safetensors"}
    assert (
        before["config.json"]
        == hashlib.sha256((copy / "config.json").read_bytes()).hexdigest()
    )
    with open(copy / "gp.safetensors", "ab") as file:
        file.write(b" ")
    after = digests_of(copy)
    assert {name for name in before if before[name] != after[name]} == {
        "gp.safetensors"
    }


def test_statistics_of_the_ground_do_not_move_the_digests_of_a_checkpoint(
    checkpoint_path: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(checkpoint_path, tmp_path / "copy"))
    (copy / "ground.json").unlink()
    assert digests_of(copy) == digests_of(checkpoint_path)


def test_statistics_of_the_ground_are_the_checkpoints_own_first(
    checkpoint_path: Path, dataset: TerrainDataset, tmp_path: Path
) -> None:
    moved = TerrainDataset(shutil.copy(dataset.path, tmp_path / "d.h5"))
    own = load_checkpoint(checkpoint_path).ground
    assert own is not None
    beside = replace(own, potts_strength=0.25)
    (tmp_path / "d.ground.json").write_text(beside.to_json())
    assert find_ground_statistics(str(checkpoint_path), moved) == own
    assert find_ground_statistics({"part": "oracle"}, moved) == beside
    assert find_ground_statistics("somewhere.py:Mine", moved) == beside
    (tmp_path / "d.ground.json").unlink()
    # of tiny-v1, of more maps than these
    shipped = find_ground_statistics("ideal", moved)
    assert shipped not in (own, beside)
    assert shipped.layer_means["rgb"] == pytest.approx(own.layer_means["rgb"], rel=0.1)


@pytest.mark.parametrize(("name", "pairs"), [("stakes-v1", 2), ("paper-v1", 0)])
def test_shipped_checkpoints_bring_the_statistics_of_their_recipe(
    name: str, pairs: int
) -> None:
    dataset = TerrainDataset(find_dataset(f"{name}-test"))
    found = find_ground_statistics(name, dataset)
    assert found == find_ground_statistics("oracle", dataset)
    assert len(found.look_alikes) == pairs
    assert (found.potts_strength > 0) == bool(pairs)


def test_missing_statistics_of_the_ground_are_refused_with_the_command_that_makes_them(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = TerrainDataset(shutil.copy(dataset.path, tmp_path / "d.h5"))
    other = replace(dataset.recipe, occupancy=(*reversed(dataset.recipe.occupancy),))
    monkeypatch.setattr(TerrainDataset, "recipe", other)
    with pytest.raises(ConfigError, match=f"`benchnav-datagen ground {moved.path}`"):
        find_ground_statistics("oracle", moved)
    monkeypatch.setattr(TerrainDataset, "splits", {"test/std": {}})
    with pytest.raises(
        ConfigError,
        match=r"`benchnav-datagen ground TRAINING_DATA --out .*/d\.ground\.json`",
    ):
        find_ground_statistics("oracle", moved)


def test_the_layer_seen_is_one_where_nothing_is_said_of_it() -> None:
    observation = make_terrain(batch=2, size=8).observe()
    given = layers_of(observation, ("rgb", "seen"))
    assert given["seen"].dtype == torch.float32
    assert torch.equal(given["seen"], torch.ones(2, 8, 8))
    mask = (torch.arange(8) < 3).float().expand(2, 8, 8)
    masked = replace(observation, layers={"seen": mask})
    assert torch.equal(layers_of(masked, ("seen",))["seen"], mask)
    assert set(layers_of(masked, ("rgb",))) == {"rgb"}
    with pytest.raises(ConfigError) as refused:
        layers_of(observation, ("vegetation_m",))
    assert "seen" not in str(refused.value)


def test_another_class_table_is_told_in_one_line(
    checkpoint_path: Path, dataset: TerrainDataset
) -> None:
    model = load_model(checkpoint_path)
    assert class_mismatch(model, dataset.recipe) == ""
    assert (
        class_mismatch(Spy(), dataset.recipe)
        == class_mismatch(Oracle(), dataset.recipe)
        == ""
    )
    classes = dataset.recipe.classes
    other = replace(
        dataset.recipe, classes=(replace(classes[0], name="lava"), *classes[1:])
    )
    for asked in (model, load_checkpoint(checkpoint_path)):
        line = class_mismatch(asked, other, "model 'mine'")
        assert line.startswith(
            "model 'mine' was trained on other classes than those of tiny-v1: "
        )
        assert "lava" in line
        assert "\n" not in line


def test_a_checkpoint_is_found_by_path_and_by_name(
    checkpoint_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "mine").symlink_to(checkpoint_path)
    monkeypatch.chdir(tmp_path)
    terrain = make_terrain(classes=10)
    by_path, by_name = (
        predict(load_model(source), terrain) for source in (checkpoint_path, "mine")
    )
    assert torch.equal(by_path.weights, by_name.weights)
    assert by_path.weights.shape == (2, 10, 16, 16)


def test_a_checkpoint_with_one_half_says_how_to_train_the_other(
    checkpoint_path: Path,
) -> None:
    whole = load_checkpoint(checkpoint_path)
    half = replace(whole, parts={"gp": whole.part("gp")})
    with pytest.raises(CheckpointError, match="benchnav-train classifier"):
        open_checkpoint(half)


def test_a_run_with_the_oracle_loads_no_heavy_library() -> None:
    code = (
        "import sys; from benchnav.models.predictor import load_model; load_model('oracle'); "
        "import benchnav.eval.run.runner; "
        "from benchnav.planning.planners.compilation import can_compile; can_compile(); "
        "heavy = 'lightning', 'gpytorch', 'segmentation_models_pytorch', 'torch._dynamo', 'matplotlib', 'rerun'; "
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("without_gradients", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("kind", ["shallow", "deep", "pool", "mdn"])
def test_a_checkpoint_is_the_same_model_where_gradients_are_switched_off(
    kind: str, without_gradients: type, checkpoint_path: Path, tmp_path: Path
) -> None:
    path = {"deep": checkpoint_path, "shallow": Path("stakes-v1")}.get(
        kind, tmp_path / kind
    )
    if kind == "pool":
        there = load_checkpoint(checkpoint_path)
        save_checkpoint(path, there.with_part("classifier-2", there.part("classifier")))
    if kind == "mdn":
        config = MDNConfig(encoder="mobilenet_v2", hidden=8)
        network = MixtureDensityModel(config).build(seed=1)
        part = Part(
            config=asdict(config),
            tensors=dict(network.state_dict()),
            seed=0,
            metrics={},
            data_id="",
            data_digest="",
        )
        save_checkpoint(
            path, Checkpoint(class_names=("a",), model="mdn", parts={"mdn": part})
        )
    terrain = make_terrain(classes=10)
    wanted = predict(load_model(path.name if kind == "shallow" else path), terrain)
    with without_gradients():
        model = load_model(path.name if kind == "shallow" else path)
        inside = predict(model, terrain)
    assert torch.is_grad_enabled()
    outside = predict(model, terrain)
    for name in ("weights", "means", "stds"):
        assert torch.equal(getattr(inside, name), getattr(wanted, name))
        assert torch.equal(getattr(outside, name), getattr(wanted, name))
        assert not getattr(outside, name).is_inference()


def test_a_family_is_no_model_and_a_checkpoint_of_an_unknown_one_says_so(
    checkpoint_path: Path,
) -> None:
    with pytest.raises(ConfigError, match="'mdn', which is a family of models"):
        load_model("mdn")
    foreign = replace(load_checkpoint(checkpoint_path), model="theirs")
    with pytest.raises(
        CheckpointError, match=r"got a checkpoint of 'theirs'. Install the package"
    ):
        open_checkpoint(foreign)


def test_the_oracle_the_ideal_and_the_clairvoyant_know_each_their_own() -> None:
    terrain = make_terrain()
    shape = (2, 4, 16, 16)
    seen = TraversabilityMixture(
        torch.full(shape, 0.25), torch.rand(shape), torch.full(shape, 0.1), (0, 0, 1, 1)
    )
    asked: list[Terrain] = []

    def look_alikes(given: Terrain) -> TraversabilityMixture:
        asked.append(given)
        return seen

    alike = replace(terrain, look_alikes=look_alikes)
    assert predict(load_model("oracle"), alike) == terrain.truth
    assert not asked  # before anyone wants to know
    assert predict(load_model("ideal"), alike) == seen
    assert [given is alike for given in asked] == [True]
    assert predict(load_model("ideal"), terrain) == terrain.truth
    known = predict(load_model("clairvoyant"), alike)
    for level in (0.0, 0.5, 0.99):
        torch.testing.assert_close(
            known.cvar(level), terrain.traversability, atol=1e-6, rtol=0
        )
    torch.testing.assert_close(
        known.most_likely().mean(), terrain.traversability, atol=1e-6, rtol=0
    )


def test_only_true_distributions_have_no_nugget() -> None:
    assert [nugget_of(model) for model in (Oracle(), Clairvoyant())] == [0, 0]
    assert nugget_of(Ideal()) == nugget_of(load_model("stakes-v1")) > 0
