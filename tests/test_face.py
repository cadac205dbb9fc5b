"""The public names: which they are, that each can be had, and what importing them
costs.
"""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent

FACES = {
    "benchnav": "Batch BenchnavError CheckpointError ConditionedDistribution ConfigError DatasetError Grid "
    "Observation QuantileDistribution Results Terrain TrainingError TraversabilityDistribution TraversabilityMixture "
    "evaluate open_run pool register",
    "benchnav.datagen": "DrawnMaps Layer Recipe Streams TerrainClass TerrainDataset TerrainMaps create_dataset "
    "find_dataset generate load_recipe recipe_from_dict shipped_recipes",
    "benchnav.env": "EgocentricEnv EgocentricVectorEnv OffRoadEnv OffRoadVectorEnv PolicyPlanner",
    "benchnav.eval": "Between Comparison Condition Results Suite compare_runs evaluate open_run read_report read_steps "
    "run_suite write_report",
    "benchnav.eval.figures": "RunData Waterfall figures_of",
    "benchnav.metrics": "Energy Episode LearningRecord Metric MetricError SHIPPED",
    "benchnav.viz": "Curves Drive Figure condition_colours draw_drive draw_estimates draw_interval draw_path "
    "legend_outside line_looks mark panel_grid planner_colours planner_name risk_name save_twice show_map stack_panels "
    "styled",
    "benchnav.models": "Checkpoint ModelFamily Part TrainOptions TrainableModel TrainingConfig "
    "TraversabilityModel Window evaluate_model find_checkpoint fit_model list_checkpoints load_checkpoint "
    "load_model measure_margin predict predict_tiles save_checkpoint write_risk_maps",
    "benchnav.planning": "AStarDWA AStarMPPI Ackermann Appearance Belief Bicycle CLRRT Classes Contact Copula "
    "CovarianceModel DifferentialDrive Endpoints Footprint FreeSpace Full GoalDistance "
    "LocalPlanner MPPI MPPIConfig Measurement Near NearOptimal NoiseKey Objective Optimal "
    "Plan PlanStatus Planner Probe Problem Robot Rules SPEED STEERING Sensor Simulation "
    "SkidSteer Static Step Straight TURN_RATE Task TravelTime Unicycle World "
    "create_simulation distance minimum_over_footprint pose_problem CVaR Chance Prediction "
    "Body Calibrated CustomSoil Entrapment Isotropic Janosi Physics Soil "
    "ExpectedTime Mean RiskMeasure SingleClass TimeCVaR VaR",
    "benchnav.testing": "check_belief check_metric check_model check_objective check_planner check_risk check_robot "
    "check_sensor",
}
EACH = pytest.mark.parametrize("name", FACES)


def face(name: str) -> ModuleType:
    return importlib.import_module(name)


@EACH
def test_the_public_names_are_these(name: str) -> None:
    assert face(name).__all__ == sorted(FACES[name].split())


def test_an_old_name_is_answered_with_the_new_one() -> None:
    with pytest.raises(
        ImportError,
        match=r"^benchnav.planning.OptimalBound is now benchnav.planning.NearOptimal.$",
    ):
        exec("from benchnav.planning import OptimalBound")


@EACH
def test_every_public_name_can_be_had_and_lies_in_its_package(name: str) -> None:
    for public in face(name).__all__:
        value = getattr(face(name), public)
        assert getattr(value, "__module__", name).startswith(name)
        assert public in dir(face(name))
    with pytest.raises(
        AttributeError, match=f"module '{name}' has no attribute 'Nothing'"
    ):
        face(name).Nothing  # noqa: B018


@EACH
def test_no_module_takes_the_place_of_a_public_name_when_it_is_imported(
    name: str,
) -> None:
    folder = ROOT.joinpath(*name.split("."))
    modules = {path.stem for path in folder.glob("*") if path.suffix in ("", ".py")}
    hidden = modules & set(face(name).__all__)
    assert all(isinstance(getattr(face(name), each), ModuleType) for each in hidden)


@EACH
def test_editors_are_told_the_same_names_of_the_same_modules(name: str) -> None:
    folder = ROOT.joinpath(*name.split("."))
    stub = (folder / "__init__.pyi").read_text()
    told = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert all(f'"{public}"' in stub.partition("__all__")[2] for public in told)
    (call,) = (
        node.value
        for node in ast.parse((folder / "__init__.py").read_text()).body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call)
    )
    table = ast.literal_eval(call.args[1])
    pairs = [
        (module, *name.split(" as "))
        for module, names in table.items()
        for name in names
    ]
    assert told == {names[-1]: (module, names[0]) for module, *names in pairs}


def fresh(code: str, *arguments: str) -> str:
    """What code prints in a new process."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


HEAVY = "torch", "lightning", "pandas", "matplotlib", "h5py"


@EACH
def test_importing_a_package_loads_nothing_heavy(name: str) -> None:
    loaded = fresh(f"import sys, {name}; print(*sys.modules)").split()
    assert not {module.partition(".")[0] for module in loaded} & set(HEAVY)


def test_importing_the_package_registers_its_environments() -> None:
    code = "import gymnasium, benchnav; print(*(gymnasium.spec(f'benchnav/OffRoad-v{n}').entry_point for n in (0, 1)))"
    assert fresh(code).split() == [
        "benchnav.env.environment:OffRoadEnv",
        "benchnav.env.egocentric:EgocentricEnv",
    ]


COMMAND = """
import sys
from importlib import import_module
module, sys.argv = sys.argv[1], sys.argv[1:]
try:
    status = import_module(module).main()
except SystemExit as ended:
    status = ended.code
assert not status, status
heavy = {name.partition(".")[0] for name in sys.modules} & {"torch", "lightning"}
assert not heavy, heavy
"""


@pytest.mark.parametrize(
    "words",
    [
        *(f"{package} --help" for package in ("datagen", "models", "eval")),
        "datagen list",
        "datagen show paper-v1",
        "datagen create tiny-v1 --out {folder}/tiny.h5",
    ],
)
def test_what_needs_no_pytorch_loads_none(words: str, tmp_path: Path) -> None:
    package, *arguments = words.format(folder=tmp_path).split()
    fresh(COMMAND, f"benchnav.{package}.cli", *arguments)


@EACH
def test_no_public_name_is_that_of_a_commands_function(name: str) -> None:
    # The parser would ask the package for it, and load its module.
    text = "".join(
        path.read_text()
        for path in ROOT.glob("benchnav/**/c*.py")
        if path.stem in ("cli", "command")
    )
    functions = {
        node.name
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef)
    }
    assert not functions & set(face(name).__all__)


EXAMPLES = [*ROOT.glob("examples/**/*.py"), ROOT / "studies" / "risk" / "off_by.py"]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")]


def imported_from(code: str) -> set[str]:
    tree = ast.parse(code)
    named = {
        node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
    }
    named |= {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    return {name for name in named if name.partition(".")[0] == "benchnav"}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_import_from_the_faces_alone(path: Path) -> None:
    assert imported_from(path.read_text()) <= set(FACES)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_pages_import_from_the_faces_alone(path: Path) -> None:
    blocks = path.read_text().split("```python\n")[1:]
    for block in blocks:
        assert imported_from(block.partition("```")[0]) <= set(FACES)


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_files_that_contributors_are_sent_to_are_there(name: str) -> None:
    text = (ROOT / name).read_text()
    named = re.findall(r"`((?:benchnav|tests|docs)/[\w/.]+)`", text)
    assert len(named) > 9
    for path in named:
        assert "NAME" in path or (ROOT / path).exists(), path
