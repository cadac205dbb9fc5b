"""Source archive and wheel hold the package with the shipped maps and models, and run
where there is no repository.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from benchnav.core import shipped_files as shipped

ROOT = Path(__file__).parents[1]
MOST_BYTES = 12e6
IN_REPOSITORY_ALONE = "checkpoints/paper-v1/"


def shipped_files() -> tuple[str, ...]:
    """The list in setup.py, which is not run."""
    pytest.importorskip("setuptools")
    spec = importlib.util.spec_from_file_location(
        "setup_of_benchnav", ROOT / "setup.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.SHIPPED


def built(what: str, source: Path, out: Path) -> Path:
    """A `wheel` or an `sdist` of a source tree, as `make wheel` builds it."""
    pytest.importorskip("setuptools", minversion="77")
    out.mkdir()
    build = f"from setuptools import build_meta; print(build_meta.build_{what}({str(out)!r}))"
    subprocess.run(
        [sys.executable, "-c", build], cwd=source, check=True, capture_output=True
    )
    (path,) = out.iterdir()
    return path


def files_of_git(*folders: str) -> list[str]:
    if not (ROOT / ".git").exists():
        pytest.skip("no git checkout")
    listed = subprocess.run(
        ["git", "ls-files", "-z", *folders],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    return [
        name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()
    ]


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A source archive built of a copy of the repository, in which a user has made maps
    and a model.
    """
    work = tmp_path_factory.mktemp("archive")
    copy = work / "copy"
    own = (
        "datasets/mine-test.h5",
        "checkpoints/mine/config.json",
        "checkpoints/paper-v1/notes.json",
    )
    for name in (*files_of_git(), *own):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        if name in own:
            (copy / name).write_text("{}")
        else:
            shutil.copyfile(ROOT / name, copy / name)
    return built("sdist", copy, work / "out")


@pytest.fixture(scope="module")
def wheel(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built of the source archive."""
    work = tmp_path_factory.mktemp("wheel")
    with tarfile.open(archive) as packed:
        packed.extractall(work, filter="data")
    (source,) = work.iterdir()
    return built("wheel", source, work / "out")


def test_the_source_archive_holds_what_git_has(archive: Path) -> None:
    with tarfile.open(archive) as packed:
        names = {
            name.partition("/")[2]
            for name in packed.getnames()
            if packed.getmember(name).isfile()
        }
    made = {name for name in names if name.startswith("benchnav.egg-info/")} | {
        "PKG-INFO",
        "setup.cfg",
    }
    kept = {name for name in files_of_git() if not name.startswith(IN_REPOSITORY_ALONE)}
    assert names - made == kept - {".gitignore"}


def test_the_wheel_holds_the_package_and_what_is_shipped_and_nothing_else(
    wheel: Path,
) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        inside = {f"benchnav/_shipped/{name}" for name in shipped_files()}
        same = [
            archive.read(f"benchnav/_shipped/{name}") == (ROOT / name).read_bytes()
            for name in shipped_files()
        ]
    package = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "benchnav").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert names == package | inside
    assert all(same)
    assert wheel.stat().st_size < MOST_BYTES


def test_what_is_shipped_is_what_git_has() -> None:
    listed = files_of_git("datasets", "checkpoints")
    named = [name for name in listed if not name.startswith(IN_REPOSITORY_ALONE)]
    assert sorted(shipped_files()) == sorted(named)


def test_out_of_the_wheel_the_shipped_maps_and_models_are_found(
    wheel: Path, tmp_path: Path
) -> None:
    site, here = tmp_path / "site", tmp_path / "here"
    here.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    # A package that has the name of a folder of ours must not be taken for it.
    (site / "datasets").mkdir()
    look = """
import benchnav
from benchnav.datagen.files.find import dataset_folders, find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint_folders import find_checkpoint, list_checkpoints
from benchnav.models.predictor import load_model
print(benchnav.__file__, *dataset_folders())
print(*(TerrainDataset(find_dataset(name)).path for name in ("paper-v1", "stakes-v1")))
print(*sorted(path.name for path in list_checkpoints()), find_checkpoint("stakes-v1"))
print(type(load_model("stakes-v1")).__name__)
try:
    find_checkpoint("paper-v1")
except benchnav.ConfigError as error:
    print(str(error).partition(" Copy ")[0].replace(" ", "_"))
"""
    told = subprocess.run(
        [sys.executable, "-P", "-c", look], cwd=here, check=True, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(site)},
    ).stdout.split()  # fmt: skip
    inside = site / "benchnav" / "_shipped"
    assert told == [
        *(str(site / "benchnav" / "__init__.py"), "datasets", str(inside / "datasets")),
        *(
            str(inside / "datasets" / f"{name}-test.h5")
            for name in ("paper-v1", "stakes-v1")
        ),
        *(
            "stakes-v1",
            "stakes-v1-masked",
            str(inside / "checkpoints" / "stakes-v1"),
            "FusedModel",
        ),
        "Expected_the_checkpoint_paper-v1_in_checkpoints/,_got_no_such_folder."
        "_The_wheel_does_not_contain_this_checkpoint,_because_it_is_too_large.",
    ]


def test_in_a_checkout_they_are_beside_the_package() -> None:
    assert shipped.shipped_folder("datasets") == ROOT / "datasets"
    assert shipped.shipped_folder("checkpoints") == ROOT / "checkpoints"
