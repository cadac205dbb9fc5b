"""The template of a package is installed, found by its entry points, driven with, and
keeps its own tests.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from tests.commands import call

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the template, without asking any index."""
    pytest.importorskip("setuptools", minversion="77")
    pytest.importorskip("pip")
    work = tmp_path_factory.mktemp("template")
    shutil.copytree(
        ROOT / "examples" / "template",
        work / "template",
        ignore=shutil.ignore_patterns("build"),
    )
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
    ]
    subprocess.run(
        [*pip, "--target", work / "site", work / "template"],
        check=True,
        capture_output=True,
    )
    return work / "site"


def test_its_parts_are_driven_with_by_name(
    site: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(str(site))
    asked = (
        "--planners",
        "[straight,{part: rays, options: {rays: 24}}]",
        "--model",
        "slope:0.02",
    )
    ground = (
        "--data",
        "stakes-v1",
        "--scenarios",
        "[std]",
        "--maps",
        "2",
        "--world.time_budget_s",
        "60",
    )
    out = tmp_path / "run"
    assert not call(
        "eval",
        "run",
        *asked,
        *ground,
        "--risks",
        "[mean]",
        "--record",
        "none",
        "--out",
        out,
    )
    rows = pd.read_parquet(out / "episodes.parquet")
    own = rows[rows["planner"] == "rays"]
    assert list(own["model"]) == ["slope:0.02"] * 2
    assert list(own["outcome"]) == ["success"] * 2
    capsys.readouterr()
    assert not call("eval", "list", "planner", "model")
    said = capsys.readouterr().out
    assert "\nplanner rays: Planner that turns to the ray" in said
    assert "\nmodel slope: Model in which λ falls" in said


def test_its_own_tests_pass_where_it_is_installed(site: Path, tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "template" / "tests" / "test_parts.py", tmp_path)
    path = os.pathsep.join(map(str, (site, ROOT)))
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_parts.py"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True,
    )  # fmt: skip
    assert "2 passed" in ran.stdout, ran.stdout
