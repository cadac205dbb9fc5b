"""Imports go one way: root -> datagen -> planning and models -> eval; only entry points import a cli."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "benchnav"
ALLOWED = {
    "": set(),
    "datagen": {"datagen"},
    "planning": {"planning"},
    "models": {"models", "datagen"},
    "eval": {"eval", "datagen", "models", "planning"},
}
# planning's environment alone reads datasets.
EXTRA = {"planning/env.py": {"datagen"}}


def imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
    return {name for name in found if name.startswith("benchnav.")}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path: Path) -> None:
    place = path.relative_to(PACKAGE)
    home = place.parts[0] if len(place.parts) > 1 else ""
    allowed = ALLOWED[home] | EXTRA.get(place.as_posix(), set())
    for name in imported(path):
        first = name.split(".")[1]
        if (PACKAGE / first).is_dir():
            assert first in allowed, f"{place} imports {name}"
        assert not name.endswith(".cli"), f"{place} imports a cli"


def test_no_drawers_without_a_label() -> None:
    names = {path.stem for path in PACKAGE.rglob("*.py")} | {
        path.name for path in PACKAGE.rglob("*") if path.is_dir()
    }
    assert not names & {"utils", "util", "common", "helpers", "misc"}
