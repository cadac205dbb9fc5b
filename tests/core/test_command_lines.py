"""Command lines of the three commands, good and bad: what the function receives, or the
one line that is said.
"""

# ruff: noqa: E501 - each message stands on one line, as users see it

import functools
import shlex
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

import pytest

import benchnav.datagen.cli
import benchnav.eval.cli
import benchnav.models.cli
from benchnav.core import command
from benchnav.core.errors import ConfigError
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.recipe.recipe import Recipe
from tests.commands import call

CLIS = {
    "datagen": benchnav.datagen.cli,
    "train": benchnav.models.cli,
    "eval": benchnav.eval.cli,
}

FILES = {
    "s.yaml": "world: stakes\nmaps: 3\n",
    "mapping.yaml": "world: {preset: stakes, correlation_m: 3}\n",
    "unknown.yaml": "risk: mean\n",
    "null.yaml": "maps:\n",
    "type.yaml": "maps: ten\n",
    "list.yaml": "- a\n",
    "broken.yaml": "maps: 1\na: [1\n",
    "empty.yaml": "",
    "place.yaml": "file: f.h5\njson: yes\n",
    "dots.yaml": "data: d\nout: o\nclassifier.dice: 0.5\n",
    "train.yaml": "data: d.h5\nout: ckpt\nclassifier: {dice: 0.5, decoder_channels: [8, 4]}\n",
    "nested.yaml": "classifier: {encodr: resnet34}\n",
    "seed.yaml": "data: other.h5\nseed: 3\n",
}


def changed(given: dict[str, Any], defaults: Callable[[str], Any]) -> dict[str, Any]:
    """What differs from defaults, of dataclasses likewise."""
    found = {}
    for name, value in given.items():
        default = defaults(name)
        if value == default and type(value) is type(default):
            continue
        if is_dataclass(value) and not isinstance(value, type):
            required = [
                f.name
                for f in fields(value)
                if f.default is f.default_factory is MISSING
            ]
            base = (
                default
                if is_dataclass(default)
                else type(value)(**dict.fromkeys(required))
            )
            inner = {f.name: getattr(value, f.name) for f in fields(value)}
            value = changed(inner, functools.partial(getattr, base))
            if not value:
                continue
        found[name] = value
    return found


@pytest.fixture
def received(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Calls of the commands' functions, none of which runs; in a folder with some
    files.
    """
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        Path(name).write_text(content)
    Path("binary.yaml").write_bytes(b"\xff\xfe\x00\x81")
    Path("folder.yaml").mkdir()
    calls: list[dict[str, Any]] = []

    def replaced(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def record(*places: Any, **names: Any) -> int:
            bound = signature(function).bind(*places, **names)
            parameters = signature(function).parameters
            calls.append(
                changed(bound.arguments, lambda name: parameters[name].default)
            )
            return 0

        return record

    def run(
        program: str, description: str, commands: dict[str, command.Command]
    ) -> int:
        kept = {
            name: replace(one, function=replaced(one.function))
            for name, one in commands.items()
        }
        return command.run(program, description, kept)

    for cli in CLIS.values():
        monkeypatch.setattr(cli, "run", run)
    return calls


def ended(line: str) -> int:
    """Gives a command line to its command, as a shell would; returns the exit status."""
    return call(*shlex.split(line))


GOOD: list[tuple[str, dict[str, Any]]] = [
    # flags, switches, dashes
    ("eval run", {}),
    ("eval run --maps 3 --out runs/a", {"suite": {"maps": 3}, "out": "runs/a"}),
    ("eval run --maps=3 --overwrite", {"suite": {"maps": 3}, "overwrite": True}),
    ("eval run --overwrite --maps 3", {"suite": {"maps": 3}, "overwrite": True}),
    ("eval run --overwrite false", {}),
    ("eval replay r --view no", {"folder": "r", "view": False}),
    ("eval report r --out ''", {"folder": "r"}),
    ("eval run --planner-limit-s 5", {"planner_limit_s": 5.0}),
    ("eval run --planner_limit_s 1e-1", {"planner_limit_s": 0.1}),
    ("eval run --device cpu", {"device": "cpu"}),
    ("datagen preview f --contact-sheet", {"file": "f", "contact_sheet": True}),
    ("datagen preview --contact_sheet f", {"file": "f", "contact_sheet": True}),
    ("train all --data d --out o --half-precision=false", {"data": "d", "out": "o", "options": {"half_precision": False}}),
    ("datagen create tiny-v1 --seed -3", {"recipe": "tiny-v1", "overrides": [], "seed": -3}),
    ("datagen create tiny-v1 --seed null", {"recipe": "tiny-v1", "overrides": []}),
    # lists
    ("datagen preview f --maps 3", {"file": "f", "maps": [3]}),
    ("datagen preview f --maps 3,4", {"file": "f", "maps": [3, 4]}),
    ("datagen preview f --maps '[3, 4]'", {"file": "f", "maps": [3, 4]}),
    ("eval run --planners mppi", {"suite": {"planners": ("mppi",)}}),
    ("eval run --risks mean,cvar:0.5", {"suite": {"risks": ("mean", "cvar:0.5")}}),
    ("eval run --risks '[mean, ./mine.py:risk:0.5]'", {"suite": {"risks": ("mean", "./mine.py:risk:0.5")}}),
    (
        "eval run --planners '{part: mppi, options: {samples: 64}},straight'",
        {"suite": {"planners": ({"part": "mppi", "options": {"samples": 64}}, "straight")}},
    ),
    ("eval run --seeds 1,2", {"suite": {"seeds": (1, 2)}}),
    ("eval run --scenarios '[]'", {"suite": {}}),
    ("eval replay r --risk mean,cvar:0.9", {"folder": "r", "labels": {"risk": ("mean", "cvar:0.9")}}),
    ("eval compare r s --model stakes-v1 --by risk", {"folders": ["r", "s"], "labels": {"model": ("stakes-v1",)}, "by": "risk"}),
    # what is given by place
    ("datagen show f", {"file": "f"}),
    ("datagen create tiny-v1 id=a splits.train.maps=5 --out o",
     {"recipe": "tiny-v1", "overrides": ["id=a", "splits.train.maps=5"], "out": "o"}),
    ("datagen create tiny-v1 id=a --jobs 2 b=[1,2]",
     {"recipe": "tiny-v1", "overrides": ["id=a", "b=[1,2]"], "jobs": 2}),
    ("datagen import-dem d.tif --out o --classes c.tif --class-ids '{1: gravel, 9: null}'",
     {"rasters": {"classes": "c.tif", "class_ids": {1: "gravel", 9: None}},
      "options": {"out": "o"}, "dem": "d.tif", "overrides": []}),
    ("datagen import-drives log.csv --dem d.tif --out o --photo p.tif --stride 2 --splits train:1 a=1",
     {"options": {"out": "o", "stride": 2.0}, "drives": "log.csv", "overrides": ["a=1"], "dem": "d.tif",
      "photo": "p.tif", "splits": "train:1"}),
    ("eval merge out a b", {"out": "out", "parts": ["a", "b"]}),
    ("eval list", {"kinds": []}),
    # names, mappings, and keys within them
    ("eval run --world stakes", {"suite": {"world": "stakes"}}),
    ("eval run --world stakes --world.correlation_m 2",
     {"suite": {"world": {"preset": "stakes", "correlation_m": 2}}}),
    ("eval run --world.correlation_m 2 --world stakes",
     {"suite": {"world": {"preset": "stakes", "correlation_m": 2}}}),
    ("eval run --world.noise stored", {"suite": {"world": {"preset": "paper", "noise": "stored"}}}),
    ("eval run --world.immobile null", {"suite": {"world": {"preset": "paper", "immobile": None}}}),
    ("eval run --world.immobile.below 2e-1",
     {"suite": {"world": {"preset": "paper", "immobile": {"below": 0.2}}}}),
    ("eval run --world '{noise: stored}'", {"suite": {"world": {"noise": "stored"}}}),
    ("eval run --world '[paper, stakes]'", {"suite": {"world": ("paper", "stakes")}}),
    ("eval run --task.free_space.by mean", {"suite": {"task": {"free_space": {"by": "mean"}}}}),
    ("eval run --model ./m.py:M --model.options.depth 3",
     {"suite": {"model": {"part": "./m.py:M", "options": {"depth": 3}}}}),
    ("train mdn --data d --out o --trainer.devices 2 --trainer.precision 32-true",
     {"data": "d", "out": "o", "options": {"trainer": {"devices": 2, "precision": "32-true"}}}),
    ("train classifier --data d --out o --classifier.encoder resnet34 --classifier.pretrained",
     {"data": "d", "out": "o", "classifier": {"encoder": "resnet34", "pretrained": True}}),
    ("train classifier --data d --out o --classifier.decoder-channels 8,4",
     {"data": "d", "out": "o", "classifier": {"decoder_channels": (8, 4)}}),
    ("train classifier --data d --out o --classifier '{dice: 1, jitter: 0.5}' --classifier.jitter 0.25",
     {"data": "d", "out": "o", "classifier": {"dice": 1.0, "jitter": 0.25}}),
    # YAML files
    ("eval run --config demo --conditions '[]'", {"suite": {
        "data": "stakes-v1", "model": "stakes-v1", "world": "stakes", "scenarios": ("std",),
        "objectives": ("travel_time",),
    }}),
    ("eval run --config s.yaml", {"suite": {"world": "stakes", "maps": 3}}),
    ("eval run --maps 7 --config s.yaml", {"suite": {"world": "stakes", "maps": 7}}),
    ("eval run --config s.yaml --world.correlation_m 2",
     {"suite": {"world": {"preset": "stakes", "correlation_m": 2}, "maps": 3}}),
    ("eval run --config mapping.yaml --world.noise stored",
     {"suite": {"world": {"preset": "stakes", "correlation_m": 3, "noise": "stored"}}}),
    ("eval run --config mapping.yaml --world paper", {"suite": {}}),
    ("eval run --config empty.yaml", {}),
    ("eval run --config mapping.yaml --world paper --world.noise stored",
     {"suite": {"world": {"preset": "paper", "noise": "stored"}}}),
    ("datagen show --config place.yaml", {"file": "f.h5", "json": True}),
    ("train classifier --config dots.yaml", {"data": "d", "out": "o", "classifier": {"dice": 0.5}}),
    ("train classifier --config train.yaml", {
        "data": "d.h5", "out": "ckpt", "classifier": {"dice": 0.5, "decoder_channels": (8, 4)}}),
    ("train classifier --config train.yaml --classifier.dice 0.25 --classifier.encoder resnet34", {
        "data": "d.h5", "out": "ckpt",
        "classifier": {"dice": 0.25, "decoder_channels": (8, 4), "encoder": "resnet34"}}),
    ("train classifier --config train.yaml --config seed.yaml", {
        "data": "other.h5", "out": "ckpt", "options": {"seed": 3}, "classifier": {"dice": 0.5, "decoder_channels": (8, 4)}}),
]  # fmt: skip


@pytest.mark.parametrize(("line", "expected"), GOOD, ids=[line for line, _ in GOOD])
def test_a_good_line_reaches_its_function(
    line: str, expected: dict[str, Any], received: list[dict[str, Any]]
) -> None:
    assert ended(line) == 0
    assert len(received) == 1
    assert received == [
        {name: value for name, value in expected.items() if value != {}}
    ]


BAD: list[tuple[str, str]] = [
    ('eval rnu', "Expected a command among run, list, report, compare, replay, merge, rerun, verify, got 'rnu'. Did you mean 'run'?"),
    ('eval run --planer mppi', "Expected a flag of `benchnav-eval run`, got --planer. Did you mean '--planners'? See `benchnav-eval run --help`."),
    ('train evaluate oracle --data d --split test/std', "Expected a flag of `benchnav-train evaluate`, got --split. Did you mean '--splits'? See `benchnav-train evaluate --help`."),
    ('eval run --classifier.dice 1', 'Expected a flag of `benchnav-eval run`, got --classifier.dice. See `benchnav-eval run --help`.'),
    ('train classifier --data d --out o --classifier.encodr x', "Expected a flag of `benchnav-train classifier`, got --classifier.encodr. Did you mean '--classifier.encoder'? See `benchnav-train classifier --help`."),
    ('train classifier --data d --out o --classifier.encoder.x 3', "Expected a flag of `benchnav-train classifier`, got --classifier.encoder.x. Did you mean '--classifier.encoder'? See `benchnav-train classifier --help`."),
    ('eval run --maps.x 1', "Expected a flag of `benchnav-eval run`, got --maps.x. Did you mean '--maps'? See `benchnav-eval run --help`."),
    ('eval run -m 3', 'Expected a flag of `benchnav-eval run`, got -m. See `benchnav-eval run --help`.'),
    ('eval run --maps', 'Expected a value after --maps (a whole number), got none.'),
    ('eval run --maps --overwrite', 'Expected a value after --maps (a whole number), got none.'),
    ('eval run more', "Expected no further arguments, got 'more'. See `benchnav-eval run --help`."),
    ('datagen show', 'Expected FILE, got none. See `benchnav-datagen show --help`.'),
    ('datagen merge a b', 'Expected --out, got none. See `benchnav-datagen merge --help`.'),
    ('train classifier', 'Expected --data and --out, got none. See `benchnav-train classifier --help`.'),
    ('eval merge', 'Expected OUT, got none. See `benchnav-eval merge --help`.'),
    ('eval run --maps ten', "Expected --maps as a whole number, got 'ten'."),
    ('eval run --maps 1.5', "Expected --maps as a whole number, got '1.5'."),
    ('eval run --planner_limit_s fast', "Expected --planner_limit_s as a number, got 'fast'."),
    ('eval run --device gpu', "Expected --device as 'auto' or 'cpu' or 'cuda', got 'gpu'. Did you mean 'cpu'?"),
    ('eval run --record al', "Expected --record as 'none' or 'steps' or 'first' or 'failures' or 'all', got 'al'. Did you mean 'all'?"),
    ('datagen create tiny-v1 --seed x', "Expected --seed as a whole number or null, got 'x'."),
    ('datagen preview f --maps x', "Expected --maps as a list, each a whole number or null, got 'x'."),
    ('datagen preview f --maps 1,x', "Expected --maps as a list, each a whole number or null, got '1,x'."),
    ('train mdn --data d --out o --trainer 3', "Expected --trainer as a mapping or null, got '3'."),
    ('train mdn --data d --out o --trainer 3 --trainer.devices 2', "Expected a mapping in which 'devices' can be set, got '3'."),
    ('train classifier --data d --out o --classifier 3', "Expected --classifier as a mapping, got '3'."),
    ('train classifier --data d --out o --classifier.dice much', "Expected --classifier.dice as a number, got 'much'."),
    ("train classifier --data d --out o --classifier '{dise: 1}'", "Expected keys of --classifier among inputs, jitter, symmetries, crop, learning_rate, weight_decay, batch_size, max_epochs, patience, masking, architecture, encoder, pretrained, encoder_depth, decoder_channels, full_resolution, focal, dice, label_smoothing, got 'dise'. Did you mean 'dice'?"),
    ('train classifier --data d --out o --classifier.dice -1', 'Expected `dice` ≥ 0 and finite, got -1.0.'),
    ('train gp --data d --out o --gp.likelihood gausian', "Expected --gp.likelihood as 'censored' or 'gaussian', got 'gausian'. Did you mean 'gaussian'?"),
    ('eval run --config s.yml', "Expected --config to be an existing YAML file, or one of demo, full, paper, risk, severity, got 's.yml'. Did you mean 's.yaml'?"),
    ('eval run --config folder.yaml', "Expected a YAML file, got 'folder.yaml': Is a directory."),
    ('eval run --config binary.yaml', "Expected a YAML file, got 'binary.yaml': it is not text."),
    ('eval run --config broken.yaml', "Expected YAML, got broken.yaml, line 3: did not find expected ',' or ']'."),
    ('eval run --config list.yaml', 'Expected list.yaml to contain settings as `name: value`, got a value of type list.'),
    ('eval run --config unknown.yaml', "Expected keys of unknown.yaml among data, scenarios, model, models, planners, risks, robots, objectives, sensors, grounds, beliefs, world, task, maps, seed, seeds, realisations, record, conditions, hypotheses, metrics, figures, out, jobs, overwrite, planner_limit_s, shard, backend, scheduler, device, reuse_code, check_determinism, got 'risk'. Did you mean 'risks'?"),
    ('eval run --config null.yaml', 'Expected `maps` of null.yaml as a whole number, got null.'),
    ('eval run --config type.yaml', "Expected `maps` of type.yaml as a whole number, got 'ten'."),
    ('train classifier --config nested.yaml', "Expected keys of `classifier` of nested.yaml among inputs, jitter, symmetries, crop, learning_rate, weight_decay, batch_size, max_epochs, patience, masking, architecture, encoder, pretrained, encoder_depth, decoder_channels, full_resolution, focal, dice, label_smoothing, got 'encodr'. Did you mean 'encoder'?"),
    ('datagen show f --config demo', "Expected --config to be an existing YAML file, got 'demo'."),
    ("eval run --world.noise '[a'", "Expected YAML, got '[a': did not find expected ',' or ']'."),
    ('train classifier --data d --out o --classifier.encoder', 'Expected a value after --classifier.encoder (text), got none.'),
    ('train gp --data d --out o --trainer.devices', 'Expected a flag of `benchnav-train gp`, got --trainer.devices. See `benchnav-train gp --help`.'),
    ('train mdn --data d --out o --trainer.devices --resume', 'Expected a value after --trainer.devices (anything), got none.'),
    ('datagen export f --out o --fields', 'Expected a value after --fields (a list, each text or null), got none.'),
    ('eval list --planner mppi', 'Expected a flag of `benchnav-eval list`, got --planner. See `benchnav-eval list --help`.'),
    ('datagen show --file f', 'Expected a flag of `benchnav-datagen show`, got --file. See `benchnav-datagen show --help`.'),
    ('eval run --maps 1 --config', 'Expected a value after --config (text), got none.'),
]  # fmt: skip


@pytest.mark.parametrize(("line", "message"), BAD, ids=[line for line, _ in BAD])
def test_a_bad_line_ends_in_one_line(
    line: str, message: str, received: list[dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert ended(line) == 2
    assert not received
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"benchnav-{line.split()[0]}: error: {message}\n")


OVERRIDES: list[tuple[str, Callable[[Recipe], Any], Any]] = [
    ("seed=3", lambda recipe: recipe.seed, 3),
    ("splits.train.maps=50", lambda recipe: recipe.splits["train"].maps, 50),
    (
        "splits.new={scenario: std, maps: 1}",
        lambda recipe: recipe.splits["new"].maps,
        1,
    ),
    (
        "classes.dune_sand.soft.weight=0.2",
        lambda recipe: recipe.classes[9].soft.weight,
        0.2,
    ),
    ("classes.dune_sand.soft=null", lambda recipe: recipe.classes[9].soft, None),
    ("classes.gravel.noise=3e-1", lambda recipe: recipe.classes[4].noise, 0.3),
    (
        "scenarios.hs.severity=0",
        lambda recipe: recipe.scenarios["hs"].light_height,
        (0.8, 1.0),
    ),
    (
        "scenarios.low={preset: hs, ambient: 0.5}",
        lambda recipe: recipe.scenarios["low"].ambient,
        0.5,
    ),
    ("places.margin_m=4", lambda recipe: recipe.places.margin_m, 4.0),
]


@pytest.mark.parametrize(
    ("text", "value", "expected"), OVERRIDES, ids=[row[0] for row in OVERRIDES]
)
def test_an_override_reaches_the_recipe(
    text: str, value: Callable[[Recipe], Any], expected: Any, received: list[dict[str, Any]],
) -> None:  # fmt: skip
    assert ended(f"datagen create stakes-v1 id=mine '{text}'") == 0
    assert (
        value(load_recipe(received[0]["recipe"], received[0]["overrides"])) == expected
    )


BAD_OVERRIDES = [
    ("height", "Expected an override such as splits.train.maps=50, got 'height'."),
    ("a..b=3", "Expected an override such as splits.train.maps=50, got 'a..b=3'."),
    ("height=[1", "Expected YAML, got '[1': did not find expected ',' or ']'."),
    ("height=tall", "Recipe stakes-v1: Expected `height` as a whole number, got 'tall'."),
    ("height.x=3", "Expected a mapping in which 'x' can be set, got 64."),
    ("seed=null", "Recipe stakes-v1: Expected `seed` as a whole number, got null."),
    ("start_m=[1]", "Recipe stakes-v1: Expected `start_m` as a list [a number, a number] or null, got [1]."),
    ("splits=3", "Recipe stakes-v1: Expected `splits` as a mapping, got 3."),
    ("splits={3: {scenario: std, maps: 1}}", "Recipe stakes-v1: Expected keys of `splits` as text, got [3]. Put numbers in quotes."),
    ("splits.train=null", "Recipe stakes-v1: Expected `splits.train` as a mapping, got null."),
    ("splits.train.maps=ten", "Recipe stakes-v1: Expected `splits.train.maps` as a whole number, got 'ten'."),
    ("splits.train.mpas=5", "Recipe stakes-v1: Expected keys of `splits.train` among scenario, maps, solvable, got 'mpas'. Did you mean 'maps'?"),
    ("splits.trian.maps=5", "Recipe stakes-v1: Expected `splits.trian.scenario` as text, got none."),
    ("classes=[1]", "Recipe stakes-v1: Expected `classes.0` as a mapping, got 1."),
    ("classes.dune_snad.scale=3", "Expected a name among basalt, wet_clay, packed_soil, loose_soil, gravel, scree, sandstone, fine_sand, firm_sand, dune_sand, crusted_soil, drift_sand, got 'dune_snad'. Did you mean 'dune_sand'?"),
    ("classes.gravel.colour=[1,2]", "Recipe stakes-v1: Expected `classes.gravel.colour` as a list [a whole number, a whole number, a whole number], got [1, 2]."),
    ("classes.dune_sand.soft.weight=x", "Recipe stakes-v1: Expected `classes.dune_sand.soft.weight` as a number, got 'x'."),
    ("classes.dune_sand.soft.wieght=1", "Recipe stakes-v1: Expected keys of `classes.dune_sand.soft` among weight, mean, std, got 'wieght'. Did you mean 'weight'?"),
    ("classes.basalt.soft.weight=0.2", "Recipe stakes-v1: Expected `classes.basalt.soft.mean` as a number, got none."),
    ("scenarios.hs=3", "Recipe stakes-v1: Expected `scenarios.hs` as a mapping, got 3."),
    ("scenarios.hs.severity=x", "Expected `severity` of scenario 'hs' to be a finite number, got 'x'."),
    ("scenarios.hs.ambeint=1", "Recipe stakes-v1: Expected keys of `scenarios.hs` among relief_m, roughness, crater_count, crater_radius_m, crater_depth_ratio, light_height, ambient, tints, got 'ambeint'. Did you mean 'ambient'?"),
    ("places=3", "Recipe stakes-v1: Expected `places` as a mapping or null, got 3."),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"), BAD_OVERRIDES, ids=[text for text, _ in BAD_OVERRIDES]
)
def test_a_bad_override_ends_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_recipe("stakes-v1", ["id=mine", text])
    assert str(caught.value) == message


SHOWN = [
    ("eval -h", "usage: benchnav-eval"),
    ("eval run -h", "one of demo, full, paper, risk, severity"),
    ("train mdn --help", "--mdn.components"),
    ("datagen create --seed 3 --help", "recipe"),
    ("eval run --config s.yaml --print_config", "world: stakes"),
    (
        "eval run --world stakes --world.correlation_m 2 --print_config",
        "correlation_m: 2",
    ),
    ("train classifier --config train.yaml --print_config", "encoder: resnet18"),
    ("train mdn --mdn.hidden 8 --print_config", "hidden: 8"),
    ("eval run --maps 3 --print-config", "maps: 3"),
]


def test_settings_may_be_printed_without_those_that_are_as_they_were(
    received: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert ended("eval run --maps 3 --print_config=skip_default") == 0
    assert capsys.readouterr().out == "maps: 3\n"
    assert ended("eval run --config s.yaml --world.noise stored --print_config") == 0
    Path("printed.yaml").write_text(capsys.readouterr().out)
    assert ended("eval run --config printed.yaml") == 0
    assert received == [
        {"suite": {"world": {"preset": "stakes", "noise": "stored"}, "maps": 3}}
    ]


@pytest.mark.parametrize(("line", "expected"), SHOWN, ids=[line for line, _ in SHOWN])
def test_help_and_settings_are_printed_in_place_of_running(
    line: str, expected: str, received: list[dict[str, Any]],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert ended(line) == 0
    assert not received
    assert expected in " ".join(capsys.readouterr().out.split())
