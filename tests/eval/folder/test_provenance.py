from pathlib import Path

import pytest

from benchnav.core.errors import CheckpointError
from benchnav.core.sources import load_file
from benchnav.eval.experiment.condition import Condition, conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.provenance import describe_parts
from benchnav.models.checkpoint import Checkpoint, Part, save_checkpoint

PLANNERS = "benchnav.planning.planners."


def condition(**parts: str) -> Condition:
    given = {"model": "oracle", "planners": "straight", "risks": "mean"} | parts
    suite = Suite(
        **{
            name: value if name == "model" else (value,)
            for name, value in given.items()
        }
    )  # type: ignore[arg-type]
    (found,) = conditions_of(suite, lambda data: ["std"])
    return found


@pytest.mark.parametrize(
    ("parts", "own", "foreign"),
    [
        ({"planners": "mppi"}, PLANNERS + "mppi", PLANNERS + "cl_rrt.cl_rrt"),
        ({"planners": "cl_rrt"}, PLANNERS + "cl_rrt.tree", PLANNERS + "astar.dwa"),
        ({"planners": "astar_dwa"}, PLANNERS + "astar.dwa", PLANNERS + "mppi"),
        (
            {"planners": "mppi", "model": "paper-v1"},
            "benchnav.models.fused",
            PLANNERS + "cl_rrt.cl_rrt",
        ),
    ],
)
def test_the_code_of_a_unit_is_what_its_own_parts_import(
    parts: dict[str, str], own: str, foreign: str
) -> None:
    modules = describe_parts(condition(**parts))["modules"]
    assert own in modules
    assert foreign not in modules
    assert "benchnav.planning.world.simulation" in modules  # of what runs every unit
    assert "benchnav.eval.report.write" not in modules


def test_a_part_of_a_users_own_is_known_by_its_digest(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("def worst(mixture):\n    return mixture.var(0.99)\n")
    before = describe_parts(condition(planners="mppi", risks=f"{path}:worst"))
    path.write_text("def worst(mixture):\n    return mixture.var(0.9)\n")
    after = describe_parts(condition(planners="mppi", risks=f"{path}:worst"))
    assert before["modules"] == after["modules"]
    assert before["parts"] != after["parts"]
    assert list(before["parts"]) == [f"risk {path}:worst"]


def test_of_a_checkpoint_of_a_users_class_both_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    example = Path(__file__).parents[3] / "examples" / "own_model.py"
    Path("own.py").write_text(example.read_text())
    kind = load_file(Path("own.py").resolve(), Path("own.py").read_bytes()).CellModel
    network = kind().build()
    part = Part(
        config=network.settings(),
        tensors=dict(network.state_dict()),
        seed=0,
        metrics={},
        data_id="x",
        data_digest="y",
    )
    save_checkpoint(
        "c",
        Checkpoint(
            class_names=(), parts={"CellModel": part}, model="CellModel", code="z"
        ),
    )
    given = {"model": "own.py:CellModel@c"}

    def parts() -> dict[str, str]:
        return describe_parts(condition(planners="mppi", **given))["parts"]

    first = parts()
    assert set(first) == {
        "model own.py:CellModel@c",
        "class of model own.py:CellModel@c",
    }
    Path("own.py").write_text(example.read_text() + "\nMORE = 1\n")
    second = parts()
    assert {name for name in first if first[name] != second[name]} == {
        "class of model own.py:CellModel@c"
    }
    save_checkpoint(
        "c",
        Checkpoint(
            class_names=("a",), parts={"CellModel": part}, model="CellModel", code="z"
        ),
    )
    assert {name for name in first if parts()[name] != second[name]} == {
        "model own.py:CellModel@c"
    }


@pytest.mark.parametrize("name", ["./payload.py:Family", "payload:Family"])
def test_what_a_checkpoint_names_is_looked_up_and_never_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    Path("payload.py").write_text("open('sprung', 'w')\nclass Family: ...\n")
    save_checkpoint("c", Checkpoint(class_names=(), parts={}, model=name))
    with pytest.raises(CheckpointError, match="Expected a checkpoint of a model among"):
        describe_parts(condition(planners="mppi", model="c"))
    assert not Path("sprung").exists()
