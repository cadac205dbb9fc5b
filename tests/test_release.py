"""A tag is that of the version, workflows ask for targets that exist, and what targets
install is pinned.
"""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def steps(path: Path) -> list[dict[str, Any]]:
    jobs = yaml.safe_load(path.read_text())["jobs"].values()
    return [step for job in jobs for step in job["steps"]]


@pytest.mark.parametrize(
    ("tag", "status"),
    [(f"v{PROJECT['version']}", 0), ("v0.9.0", 1), (PROJECT["version"], 1)],
)
def test_a_tag_has_to_name_the_version(tag: str, status: int) -> None:
    release = next(path for path in WORKFLOWS if path.name == "release.yml")
    (check,) = [
        step["run"]
        for step in steps(release)
        if step.get("name") == "The tag names the version"
    ]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    asked = {**os.environ, "GITHUB_REF_NAME": tag, "PATH": path}
    ran = subprocess.run(
        ["bash", "-e", "-c", check], cwd=ROOT, env=asked, capture_output=True, text=True
    )
    assert ran.returncode == status, ran.stderr
    assert (f"Expected tag v{PROJECT['version']}, got {tag}" in ran.stderr) == bool(
        status
    )


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_ask_for_targets_that_exist_and_hold_no_secrets(path: Path) -> None:
    targets = set(
        re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    )
    asked = {
        word
        for step in steps(path)
        for word in re.findall(r"make ([\w-]+)", step.get("run", ""))
    }
    assert asked
    assert asked <= targets
    assert "secrets." not in path.read_text()


def test_all_that_a_target_installs_by_name_is_pinned() -> None:
    def plain(name: str) -> str:
        return re.sub(r"[-_.]+", "-", name).lower()

    pins = [
        plain(line.partition("==")[0])
        for line in (ROOT / "constraints.txt").read_text().split()
    ]
    assert len(pins) == len(set(pins))
    extras = PROJECT["optional-dependencies"].values()
    wanted = {
        plain(re.split(r"[\[<>=~ ]", requirement)[0])
        for requirements in (PROJECT["dependencies"], *extras)
        for requirement in requirements
    } - {"benchnav"}
    assert wanted <= set(pins)
