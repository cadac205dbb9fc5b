"""What a user's model may not do is told in one line, before anything is trained where
it can be.
"""

import re
from pathlib import Path

import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.sources import load_file
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import FUSED, load_checkpoint
from benchnav.models.cli import fit
from benchnav.models.nets.trainable import TrainableNetwork
from benchnav.models.training.check import fields_of, try_network
from benchnav.models.training.data import MapDataset
from benchnav.models.training.find import is_trainable
from tests.commands import call
from tests.models.training.conftest import EXAMPLE

QUICK = (
    "--trainer.precision",
    "32-true",
    "--trainer.max_epochs",
    "1",
    "--settings.batch_size",
    "5",
)


def with_hook(code: str) -> None:
    """Writes the example with one hook more."""
    text = EXAMPLE.read_text().replace(
        "    def to_distribution", f"    {code}\n\n    def to_distribution"
    )
    text = text.replace(
        "import math", "import math\nfrom torchmetrics import MeanAbsoluteError", 1
    )
    Path("own.py").write_text(text)


DISTRIBUTIONS = """

from benchnav.core.distribution import TraversabilityDistribution


@dataclass(frozen=True)
class Own(TraversabilityDistribution):
    mean_: Tensor
    std_: Tensor
    falls: bool = False

    @property
    def shape(self):
        return self.mean_.shape

    def cdf(self, value):
        share = torch.as_tensor(value) + torch.zeros_like(self.mean_)
        return 1 - share if self.falls else share

    def quantile(self, probability):
        share = torch.as_tensor(probability) + torch.zeros_like(self.mean_)
        return share if self.falls else 1 - share

    def mean(self):
        return torch.full_like(self.mean_, 0.5)


class Plain(TraversabilityDistribution):
    def __init__(self, values):
        self.values = values

    shape = property(lambda self: self.values.shape)
    cdf = quantile = lambda self, value: value + torch.zeros_like(self.values)
"""

BROKEN = {
    "shape": ("return (scores * seen).sum() / seen.sum().clamp(min=1)", "return scores",
        "a loss that is a scalar, got shape"),
    "nan": ("(scores * seen).sum()", "(scores * seen).sum() * float('nan')", "a finite loss, got nan"),
    "no gradient": ("(scores * seen).sum() /", "(scores * seen).sum().detach() /", "with a gradient, got"),
    "no number": ("return crps", "return lambda outputs, observed: 3.0", "a scalar, got float"),
    "distribution": ("return TraversabilityMixture(torch.ones_like(mean), mean, std)", "return mean",
                     "to return a TraversabilityDistribution, got Tensor"),
    "distribution's shape": ("TraversabilityMixture(torch.ones_like(mean), mean, std)",
                             "TraversabilityMixture(*(v[..., 1:] for v in (torch.ones_like(mean), mean, std)))",
                             r"to return a distribution of shape \[2, 32, 32\], got \[2, 32, 31\]"),
    "means": ("mean, std)\n\n", "mean, std * torch.nan)\n\n", r"whose `mean` is in \[0, 1\]"),
    "quantiles": ("return TraversabilityMixture(torch.ones_like(mean), mean, std)", "return Own(mean[:, 0], std[:, 0])",
                  "a distribution whose `quantile` ascends"),
    "falling cdf": ("return TraversabilityMixture(torch.ones_like(mean), mean, std)",
                    "return Own(mean[:, 0], std[:, 0], falls=True)", "a distribution whose `cdf` ascends"),
    "no dataclass": ("return TraversabilityMixture(torch.ones_like(mean), mean, std)", "return Plain(mean[:, 0])",
                     "a frozen dataclass of maps, got Plain"),
    "raises": ("hidden = self.config.hidden", "hidden = self.config.width",
        r"no attribute 'width'. See own.py, line \d+, in `configure_network`."),
    "no super": ("super().__init__(config)", "pass", r"calls super\(\).__init__\(config\)"),
    "device": ("return (scores * seen).sum() / seen.sum().clamp(min=1)", "return scores.sum().to('meta')",
        "on cpu, got it on meta"),
}  # fmt: skip


@pytest.mark.parametrize("fault", BROKEN)
def test_a_hook_that_does_not_fit_is_refused_before_anything_is_trained(
    own: Path,
    dataset: TerrainDataset,
    fault: str,
    capfd: pytest.CaptureFixture[str],
) -> None:
    old, new, expected = BROKEN[fault]
    text = EXAMPLE.read_text()
    assert old in text
    Path("own.py").write_text(text.replace(old, new) + DISTRIBUTIONS)
    assert (
        call(
            "train",
            "fit",
            "own.py:CellModel",
            "--data",
            dataset.path,
            "--out",
            "c",
            *QUICK,
        )
        == 2
    )
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert re.search(expected, line)
    assert not Path("c").exists()
    assert not Path("c.training").exists()


HOOKS = {
    "no metric": (
        "def configure_metrics(self): return {'mae': 3}",
        "Expected a network that accepts batches",
    ),
    "metrics": (
        "def update_metrics(self, outputs, target): self.metrics['rmse'].update(target, 3)",
        "Expected a network that accepts batches",
    ),
    "schedule": (
        "def configure_schedule(self, optimizer, steps): return 1 / 0",
        "ZeroDivisionError",
    ),
    "predict": (
        "def predict(self, observation): return super().predict(observation).mean()",
        "Expected the model to return a TraversabilityDistribution .* got Tensor",
    ),
    "predict raises": (
        "def predict(self, observation): return 1 / 0",
        "ZeroDivisionError",
    ),
    "stride": ("stride = 0", "`stride` of CellModel to be an integer ≥ 1, got 0"),
    "inputs": ("inputs = 3", "`inputs` and settings of CellModel .* TypeError"),
}


@pytest.mark.parametrize("fault", HOOKS)
def test_every_other_hook_is_tried_too(
    own: Path, dataset: TerrainDataset, fault: str, capfd: pytest.CaptureFixture[str]
) -> None:
    code, expected = HOOKS[fault]
    with_hook(code)
    assert (
        call(
            "train",
            "fit",
            "own.py:CellModel",
            "--data",
            dataset.path,
            "--out",
            "c",
            *QUICK,
        )
        == 2
    )
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert re.search(expected, line)
    assert not Path("c.training").exists()


def test_settings_that_no_checkpoint_could_keep_are_refused(
    own: Path, dataset: TerrainDataset, capfd: pytest.CaptureFixture[str]
) -> None:
    text = EXAMPLE.read_text().replace(
        "import math", "import math\nfrom pathlib import Path", 1
    )
    Path("own.py").write_text(
        text.replace("hidden: int = 32", "hidden: int = 32\n    log: Path = Path('a')")
    )
    assert (
        call(
            "train",
            "fit",
            "own.py:CellModel",
            "--data",
            dataset.path,
            "--out",
            "c",
            *QUICK,
        )
        == 2
    )
    assert "`inputs` and settings of" in capfd.readouterr().err
    assert not Path("c.training").exists()


@pytest.mark.parametrize("name", ["swag", "classifier", "gp"])
def test_a_class_of_a_name_that_is_ours_is_refused(
    own: Path, dataset: TerrainDataset, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    Path("own.py").write_text(
        EXAMPLE.read_text().replace("class CellModel", f"class {name}")
    )
    assert (
        call(
            "train",
            "fit",
            f"own.py:{name}",
            "--data",
            dataset.path,
            "--out",
            "c",
            *QUICK,
        )
        == 2
    )
    assert (
        f"differs from those of this package's models, got {name!r}"
        in capfd.readouterr().err
    )


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ["own.py:CellModel", "--settings.inputs", "[rgb, elevation]"],
            r"got 'elevation'\. Did you mean 'elevation_m'\?",
        ),
        (
            ["own.py:CellModel", "--settings.inputs", "[rgb, vegetation_m]"],
            "got 'vegetation_m'",
        ),
        (
            ["own.py:CellModel", "--settings.inputs", "[]"],
            "`inputs` to name at least one map layer, and none twice",
        ),
        (["own.py:CellModel", "--settings.width", "3"], "got 'width'"),
        (["own.py:CellModel", "--crop", "33"], r"`crop` from 8 to 32 cells"),
        (["own.py:CellModel", "--members", "0"], "`members` in 1–1000"),
        (
            ["own.py:CellConfig"],
            "Expected a trainable model .fused, .*mdn.* got 'own.py:CellConfig'",
        ),
        (["own.py:CellMode"], "Did you mean 'CellModel'"),
        (["oracle"], "got 'oracle'"),
        (
            ["mdm"],
            "a trainable model .fused, evidential, .* or FILE.py:Class., got 'mdm'. Did you mean 'mdn'",
        ),
        (["mdn", "--settings.architecture", "unett"], "unett"),
        (["mdn", "--settings.encoder", "resnet19"], "resnet19"),
        (
            ["mdn", "--settings.encoder", "tu-hf-hub:someone/net"],
            "got 'tu-hf-hub:someone/net'",
        ),
        (
            ["fused", "--settings.clasifier.dice", "1"],
            "`settings` of 'fused' to be among classifier and gp",
        ),
        (["fused", "--settings.classifier.architecture", "unett"], "unett"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_trained(
    own: Path,
    dataset: TerrainDataset,
    arguments: list[str],
    expected: str,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert call("train", "fit", *arguments, "--data", dataset.path, "--out", "c") == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert re.search(expected, line)
    assert not Path("c").exists()


def test_metrics_of_ones_own_are_updated_by_the_mean(
    own: Path, dataset: TerrainDataset
) -> None:
    with_hook("def configure_metrics(self): return {'mae': MeanAbsoluteError()}")
    assert (
        call(
            "train",
            "fit",
            "own.py:CellModel",
            "--data",
            dataset.path,
            "--out",
            "c",
            *QUICK,
        )
        == 0
    )
    part = load_checkpoint("c").part("CellModel")
    assert set(part.metrics) >= {"valid_loss", "valid_mae"}
    assert 0 < part.metrics["valid_mae"] < 1


def test_a_calibration_that_fails_ends_in_one_line(
    own: Path, dataset: TerrainDataset, capfd: pytest.CaptureFixture[str]
) -> None:
    with_hook("def calibrate(self, maps, device): return 1 / 0")
    assert (
        call(
            "train",
            "fit",
            "own.py:CellModel",
            "--data",
            dataset.path,
            "--out",
            "c",
            *QUICK,
        )
        == 2
    )
    assert (
        "Expected `calibrate` of CellModel to succeed, got: ZeroDivisionError"
        in capfd.readouterr().err
    )
    assert not Path("c").exists()


def test_a_setting_without_a_usual_value_is_compared_when_a_training_is_repeated(
    own: Path, dataset: TerrainDataset, capfd: pytest.CaptureFixture[str]
) -> None:
    Path("own.py").write_text(
        EXAMPLE.read_text()
        .replace("hidden: int = 32", "hidden: int")
        .replace("config: CellConfig = CellConfig()", "config: CellConfig")
    )
    where = ("fit", "own.py:CellModel", "--data", dataset.path, "--out", "c", *QUICK)
    assert call("train", *where, "--settings.hidden", 4) == 0
    assert call("train", *where, "--settings.hidden", 4, "--resume") == 0
    assert "was finished already" in capfd.readouterr().out
    assert call("train", *where, "--settings.hidden", 8, "--resume") == 2
    assert "another `hidden`" in capfd.readouterr().err


def test_what_an_epoch_draws_hangs_on_seed_and_epoch(
    own: Path, dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds: list[int] = []
    begin = TrainableNetwork.on_train_epoch_start

    def watch(network: TrainableNetwork) -> None:
        begin(network)
        seeds.append(torch.initial_seed())

    monkeypatch.setattr(TrainableNetwork, "on_train_epoch_start", watch)
    where = (
        "fit",
        "own.py:CellModel",
        "--data",
        dataset.path,
        *QUICK,
        "--trainer.max_epochs",
        3,
    )
    for out, seed in (("a", 4), ("b", 5), ("c", 4)):
        assert call("train", *where, "--out", out, "--seed", seed) == 0
    assert len({*seeds[:6]}) == 6
    assert seeds[6:] == seeds[:3]


def test_a_loss_that_divides_by_no_cell_is_told_why(
    own: Path, dataset: TerrainDataset
) -> None:
    text = EXAMPLE.read_text().replace("seen.sum().clamp(min=1)", "seen.sum()")
    network = load_file(own / "own.py", text.encode()).CellModel().build()
    maps = MapDataset(dataset.path, "train", fields_of(network)).read([0, 1])
    try_network(network, maps)
    unseen = {
        **maps,
        "traversability": torch.full_like(maps["traversability"], torch.nan),
    }
    with pytest.raises(
        ConfigError,
        match=r"got nan\. λ is NaN \(not observed\) in the whole batch",
    ):
        try_network(network, unseen)


def test_the_help_of_fit_names_all_that_can_be_trained() -> None:
    names = [FUSED, *(name for name in registry.names("model") if is_trainable(name))]
    (told,) = re.findall(
        r"a model that can be trained \(([^)]+)\)",
        " ".join((fit.__doc__ or "").split()),
    )
    assert sorted(told.split(", ")) == sorted(names)
