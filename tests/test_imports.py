"""Imports go one way: core, stats and viz, datagen, planning and models, env and
metrics, eval; so do their folders.
"""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "benchnav"

# The values that the folders of `planning` share, and the shells that Gymnasium is
# given.
VALUES = ("footprint", "free_space", "objective", "problem", "risk", "robots")
PLANNING = tuple(f"planning.{name}" for name in VALUES)
DRAWN = ("datagen.noise", "datagen.schema")  # what all of synthesis shares
SYNTHESIS = ("datagen.synth", "datagen.recipe", "datagen.layers", *DRAWN)
# Whatever is known of models beside their training and their quality.
WHOLE = ("fused", "conformal", "predictor")
STORED = ("checkpoint", "checkpoint_folders", "parts")
MODELS = tuple(
    f"models.{name}"
    for name in (*STORED, "base", "slope_gp", "nets", "zoo", "config", *WHOLE)
)
VALUES_OF_EVAL = ("eval.experiment",)
# What running writes and reports read.
WRITTEN = ("eval.folder", "eval.recording", "eval.recorded_plans")
# What figures of runs are drawn from and with.
FIGURES = (
    *(
        "eval.figures",
        "eval.failures",
        "eval.words",
        "eval.stats",
        *WRITTEN,
        *VALUES_OF_EVAL,
    ),
    *("metrics", "planning", "datagen", "viz"),
)

# What the modules of a folder may import besides the root's; a name stands for all that
# is under it.
MAY_IMPORT: dict[str, tuple[str, ...]] = {
    "": (),
    "core": ("core",),
    "stats": ("stats",),
    "viz": ("viz",),
    "datagen": ("datagen", "viz"),
    "datagen/schema.py": (),
    "datagen/noise.py": (),
    "datagen/layers": ("datagen.layers", "datagen.recipe.classes", *DRAWN),
    "datagen/recipe": ("datagen.recipe", "datagen.layers", *DRAWN),
    "datagen/synth": SYNTHESIS,
    "datagen/files": ("datagen.files", *SYNTHESIS),
    "datagen/export": ("datagen.export", "datagen.files", *SYNTHESIS),
    "datagen/dem": ("datagen.dem", "datagen.files", *SYNTHESIS),
    "models": ("models", "datagen"),
    "models/slope_gp": ("models.slope_gp", "models.config", "datagen"),
    "models/nets": (
        "models.nets",
        "models.base",
        "models.checkpoint",
        "models.parts",
        "models.config",
        "datagen",
    ),
    "models/zoo": (
        "models.zoo",
        "models.nets",
        "models.base",
        "models.checkpoint",
        "models.config",
        "datagen",
    ),
    "models/training": ("models.training", *MODELS, "datagen"),
    "models/quality": ("models.quality", *MODELS, "datagen", "viz"),
    "planning": PLANNING,
    "planning/world": (*PLANNING, "planning.world"),
    "planning/sensing": ("planning.sensing",),
    "planning/sensing/sensor.py": (
        "planning.sensing",
        "planning.footprint",
        "planning.robots",
    ),
    "planning/sensing/knowledge.py": (*PLANNING, "planning.sensing", "planning.world"),
    "planning/sensing/learner.py": (*PLANNING, "planning.sensing", "planning.world"),
    "planning/sensing/appearance.py": (
        "planning.sensing",
        "datagen.synth",
        "datagen.schema",
    ),
    "planning/planners": (*PLANNING, "planning.sensing", "planning.planners"),
    "metrics": ("metrics", *PLANNING),
    "env": ("env", "models", "planning", "datagen", "viz"),
    "testing": ("testing", "metrics", "models", "planning", "datagen"),
    "eval": ("eval", "metrics", "models", "planning", "datagen", "viz"),
    "eval/experiment": ("eval.experiment", "metrics", "models", "planning", "datagen"),
    "eval/folder": ("eval.folder", *VALUES_OF_EVAL, "models", "planning", "datagen"),
    "eval/recorded_plans.py": (),
    "eval/recording.py": ("eval.folder", "eval.recorded_plans", "planning"),
    "eval/run": (
        "eval.run",
        *WRITTEN,
        *VALUES_OF_EVAL,
        "metrics",
        "models",
        "planning",
        "datagen",
    ),
    "eval/stats": ("eval.stats", "eval.experiment", "metrics", "planning"),
    "eval/words.py": ("eval.stats", *VALUES_OF_EVAL, "planning", "viz"),
    "eval/failures.py": ("eval.words", "eval.stats", *WRITTEN, *VALUES_OF_EVAL),
    "eval/figures": FIGURES,
    "eval/report": ("eval.report", *FIGURES),
}


def modules() -> list[Path]:
    return [path.relative_to(PACKAGE) for path in sorted(PACKAGE.rglob("*.py"))]


def folder_of(place: Path) -> str:
    """The nearest entry of the table: the module's own, else that of a folder it lies
    in.
    """
    return next(
        name
        for candidate in (place, *place.parents)
        if (name := "" if candidate == Path() else candidate.as_posix()) in MAY_IMPORT
    )


def may_import(place: Path, name: str) -> bool:
    """Tells whether a module may import another, both of ours."""
    inner = name.removeprefix("benchnav").removeprefix(".")
    is_below = inner.split(".")[0] in (
        "core",
        *(() if place.parts[0] == "core" else ("stats",)),
    )
    if inner.split(".")[-1] == "cli" or ".cli." in f".{inner}.":
        return False
    return (
        not inner
        or is_below
        or any(
            f"{inner}.".startswith(f"{known}.")
            for known in MAY_IMPORT[folder_of(place)]
        )
    )


def imported(path: Path) -> set[str]:
    """Modules of ours that a file imports, wherever in it; of `from a import b` the
    module b where it is one.
    """
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if is_module(inner) else str(node.module))
    return {name for name in found if name.split(".")[0] == "benchnav"}


def is_module(name: str) -> bool:
    place = PACKAGE.parent / name.replace(".", "/")
    return place.is_dir() or place.with_suffix(".py").is_file()


@pytest.mark.parametrize("place", modules(), ids=Path.as_posix)
def test_imports_go_one_way(place: Path) -> None:
    wrong = sorted(
        name for name in imported(PACKAGE / place) if not may_import(place, name)
    )
    assert not wrong, f"{place} imports {', '.join(wrong)}"


def test_no_modules_import_one_another_in_a_circle() -> None:
    # But for a package's `__init__`, which hands names on.
    graph = {
        "benchnav." + ".".join(place.with_suffix("").parts): imported(PACKAGE / place)
        for place in modules()
    }
    TopologicalSorter(graph).prepare()  # raises where there is one


@pytest.mark.parametrize(
    ("place", "name", "allowed"),
    [
        ("core/registry.py", "benchnav.core.errors", True),
        ("core/registry.py", "benchnav.planning.robots", False),
        ("core/tables.py", "benchnav.stats.tables", False),
        ("stats/tables.py", "benchnav.core.tables", True),
        ("stats/scores.py", "benchnav.models.quality.map_sums", False),
        ("stats/episodes.py", "benchnav.eval.stats.pairs", False),
        ("models/quality/scores_of_maps.py", "benchnav.stats.scores", True),
        ("eval/stats/best.py", "benchnav.stats.best", True),
        ("datagen/files/reader.py", "benchnav.models.config", False),
        ("models/training/data.py", "benchnav.datagen.files.reader", True),
        ("models/fused.py", "benchnav.planning.risk", False),
        ("planning/problem.py", "benchnav.planning.objective", True),
        ("planning/problem.py", "benchnav.planning.planners.planner", False),
        ("planning/problem.py", "benchnav.datagen.files.reader", False),
        ("env/environment.py", "benchnav.datagen.files.reader", True),
        ("env/environment.py", "benchnav.models.predictor", True),
        ("env/environment.py", "benchnav.eval.run.rollout", False),
        ("planning/sensing/appearance.py", "benchnav.datagen.synth.elevation", True),
        ("planning/sensing/sensor.py", "benchnav.datagen.synth.elevation", False),
        ("planning/world/simulation.py", "benchnav.planning.problem", True),
        ("planning/world/simulation.py", "benchnav.planning.planners.planner", False),
        (
            "planning/planners/cl_rrt/tree.py",
            "benchnav.planning.planners.planner",
            True,
        ),
        ("planning/planners/cl_rrt/tree.py", "benchnav.planning.world.outcome", False),
        ("planning/planners/mppi.py", "benchnav.eval.experiment.condition", False),
        ("metrics/base.py", "benchnav.planning.robots", True),
        ("metrics/energy.py", "benchnav.planning.world.simulation", False),
        ("metrics/energy.py", "benchnav.eval.run.rollout", False),
        ("eval/run/rollout.py", "benchnav.planning.world.simulation", True),
        ("eval/run/rollout.py", "benchnav.eval.report.result_tables", False),
        ("eval/stats/summary.py", "benchnav.eval.run.rows", False),
        ("eval/stats/summary.py", "benchnav.eval.report.result_tables", False),
        ("eval/report/result_tables.py", "benchnav.eval.stats.summary", True),
        ("eval/report/result_tables.py", "benchnav.eval.folder.run_folder", True),
        ("eval/report/result_tables.py", "benchnav.eval.run.rollout", False),
        ("eval/report/result_tables.py", "benchnav.models.predictor", False),
        ("eval/run/runner.py", "benchnav.eval.report.write", False),
        ("eval/run/runner.py", "benchnav.eval.cli", False),
        ("eval/run/recorder.py", "benchnav.eval.recording", True),
        ("viz/maps.py", "benchnav.core.grid", True),
        ("viz/maps.py", "benchnav.datagen.schema", False),
        ("viz/figure.py", "benchnav.eval.recording", False),
        ("core/tables.py", "benchnav.viz.style", False),
        ("datagen/preview.py", "benchnav.viz.sheet", True),
        ("eval/figures/success.py", "benchnav.eval.report.write", False),
        ("eval/run/recorder.py", "benchnav.viz.maps", False),
        ("eval/recording.py", "benchnav.viz.maps", False),
        ("eval/recording.py", "benchnav.eval.run.recorder", False),
        ("eval/folder/run_folder.py", "benchnav.eval.run.runner", False),
        ("datagen/recipe/recipe.py", "benchnav.datagen.synth.generate", False),
        ("datagen/layers/vegetation.py", "benchnav.datagen.recipe.classes", True),
        ("datagen/layers/vegetation.py", "benchnav.datagen.recipe.recipe", False),
        ("datagen/synth/generate.py", "benchnav.datagen.files.reader", False),
        ("datagen/files/reader.py", "benchnav.datagen.dem.importer", False),
        ("models/nets/classifier.py", "benchnav.models.training.fit", False),
        ("models/zoo/swag.py", "benchnav.models.nets.joined", True),
        ("models/nets/mdn.py", "benchnav.models.zoo.mean_variance", False),
        ("models/zoo/swag.py", "benchnav.models.training.fit", False),
        ("models/slope_gp/gp.py", "benchnav.models.training.fit", False),
        ("models/training/fit.py", "benchnav.models.quality.measure", False),
        ("models/quality/measure.py", "benchnav.models.nets.classifier", True),
        ("eval/cli.py", "benchnav.models.cli", False),
    ],
)
def test_the_rule_knows_its_folders(place: str, name: str, allowed: bool) -> None:
    assert may_import(Path(place), name) == allowed


def test_every_folder_has_a_rule_or_lies_in_one_that_has() -> None:
    named = {Path(name) for name in MAY_IMPORT if name}
    for name in named:
        assert (PACKAGE / name).exists(), f"{name} is in the table alone"
    for folder in {place.parent for place in modules()} - {Path()}:
        assert named & {folder, *folder.parents}, f"{folder} has no rule"


def test_values_of_planning_are_all_that_lies_beside_its_folders() -> None:
    beside = {path.stem for path in (PACKAGE / "planning").glob("*.py")} - {"__init__"}
    assert beside == set(VALUES)


def test_no_folders_without_a_label() -> None:
    names = {place.stem for place in modules()} | {
        parent.name for place in modules() for parent in place.parents
    }
    assert not names & {"utils", "util", "common", "helpers", "misc"}
