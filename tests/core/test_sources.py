"""What identifies a part: its source and what that imports, the files that it lists,
and those that options name.
"""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from benchnav.core import sources
from benchnav.core.errors import ConfigError
from benchnav.core.registry import Part, find, option_files
from benchnav.core.renamed import IMPORTS
from benchnav.core.sources import imported_sources

PART = """
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "lib"))
import first_aid
sys.path.pop(0)


class Planner:
    def __init__(self, weights: str = "", inner: dict | None = None) -> None:
        self.weights = weights

    def plan(self):
        import late_aid
        from aid_package.deep import gain
        import importlib
        return importlib.import_module("named_aid"), gain
"""
IMPORTED = {
    "lib/first_aid.py": "import second_aid\n",
    "lib/second_aid.py": "x = 1\n",
    "late_aid.py": "x = 1\n",
    "named_aid.py": "x = 1\n",
    "aid_package/__init__.py": "",
    "aid_package/deep/__init__.py": "from ..other import gain\n",
    "aid_package/other.py": "from . import beside\ngain = 1\n",
    "aid_package/beside.py": "x = 1\n",
}


_DIGEST = (
    "import sys; from benchnav.core.registry import find; "
    "print(find('planner', sys.argv[1] + ':Planner').digest)"
)


@pytest.fixture
def part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A part of several files, away from the working folder."""
    known, path = set(sys.modules), list(sys.path)
    place = tmp_path / "parts"
    for name, text in IMPORTED.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    (place / "aid_package" / "unused.py").write_text("x = 1\n")
    (place / "unused_aid.py").write_text("x = 1\n")
    (place / "part.py").write_text(PART)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    yield place / "part.py"
    sys.path[:] = path
    for name in set(sys.modules) - known:
        del sys.modules[name]


def digest(part: Path) -> str:
    return find("planner", f"{part}:Planner").digest


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(ConfigError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", IMPORTED)
def test_a_change_of_any_file_that_is_imported_changes_the_digest(
    part: Path, name: str
) -> None:
    before = digest(part)
    assert digest(part) == before
    changed = part.parent / name
    changed.write_text(changed.read_text() + "# edited\n")
    assert digest(part) != before


@pytest.mark.parametrize("name", ["unused_aid.py", "aid_package/unused.py"])
def test_what_is_not_imported_does_not(part: Path, name: str) -> None:
    before = digest(part)
    (part.parent / name).write_text("x = 2\n")
    assert digest(part) == before


def test_the_standard_library_and_what_is_installed_have_versions_instead(
    part: Path,
) -> None:
    content = PART + "import torch.nn, json, pytest, benchnav.core.errors\n"
    modules = imported_sources(part.parent, "", content.encode())
    assert "late_aid" in modules
    assert not {name.partition(".")[0] for name in modules} & {
        "numpy",
        "torch",
        "json",
        "pytest",
        "benchnav",
        "sys",
    }
    assert "numpy" in sys.modules  # it could have been followed


def test_what_was_installed_into_a_folder_of_its_own_is_left_out_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "target"
    (target / "other-1.0.dist-info").mkdir(parents=True)
    (target / "other_aid.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(target)
    sources.installed_folders.cache_clear()
    try:
        assert imported_sources(tmp_path, "", b"import other_aid") == {}
    finally:
        sources.installed_folders.cache_clear()


def test_the_same_files_elsewhere_have_the_same_digest(
    part: Path, tmp_path: Path
) -> None:
    """A fresh process says so, which has imported neither."""
    other = tmp_path / "copy"
    part.parent.rename(other)
    ran = subprocess.run(
        [sys.executable, "-c", _DIGEST, str(other / "part.py")],
        capture_output=True,
        text=True,
        check=True,
    )
    other.rename(part.parent)
    assert ran.stdout.strip() == digest(part)


def test_a_process_that_has_imported_an_older_file_is_like_no_other(part: Path) -> None:
    """Python imports a module once: what a long-lived worker runs is not what now lies
    on the disk.
    """
    helper = part.parent / "lib" / "second_aid.py"
    older = digest(part)
    helper.write_text("x = 2\n")
    with_both = digest(part)
    fresh = subprocess.run(
        [sys.executable, "-c", _DIGEST, str(part)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert len({older, with_both, fresh.stdout.strip()}) == 3
    helper.write_text("x = 1\n")
    assert digest(part) == older


def test_a_part_of_a_module_is_its_package_and_what_that_imports(
    part: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(part.parent)
    inner = part.parent / "aid_package" / "planner.py"
    inner.write_text(
        "import late_aid\n\n\nclass Planner:\n    files = ('planner.txt',)\n"
    )
    inner.with_suffix(".txt").write_text("1")
    importlib.invalidate_caches()

    def now() -> str:
        return find("planner", "aid_package.planner:Planner").digest

    seen = [now()]
    for changed in ("aid_package/unused.py", "late_aid.py", "aid_package/planner.txt"):
        (part.parent / changed).write_text("x = 2\n")
        seen.append(now())
    assert len(set(seen)) == 4
    (part.parent / "unused_aid.py").write_text("x = 2\n")
    assert now() == seen[-1]


def test_files_that_a_part_lists_are_in_its_digest(part: Path) -> None:
    part.write_text("class Planner:\n    files = ('weights.bin', 'tables')\n")
    assert "got 'weights.bin', which does not" in refusal(lambda: digest(part))
    (part.parent / "weights.bin").write_bytes(b"1")
    (part.parent / "tables").mkdir()
    seen = {digest(part)}
    for changed in ("weights.bin", "tables/a", "tables/b"):
        (part.parent / changed).write_bytes(b"22")
        seen.add(digest(part))
    assert len(seen) == 4
    part.write_text(
        "class Planner:\n    def __init__(self, files: tuple[str, ...] = ('x',)) -> None: ...\n"
    )
    assert digest(part)  # an option of that name lists nothing


def test_files_and_folders_that_options_name_are_known_by_what_they_hold(
    part: Path,
) -> None:
    Path("weights.npz").write_bytes(b"1")
    Path("tables").mkdir()
    Path("tables", "a").write_bytes(b"1")
    options = {
        "weights": "weights.npz",
        "inner": {"tables": ["tables", "", "mean"], "level": 0.5},
    }
    asked = Part(part=f"{part}:Planner", label="", kind="planner", options=options)
    seen = [option_files(asked)]
    assert set(seen[0]) == {"weights.npz", "tables"}
    Path("weights.npz").write_bytes(b"2")
    seen.append(option_files(asked))
    assert [seen[1][name] == seen[0][name] for name in ("weights.npz", "tables")] == [
        False,
        True,
    ]
    os.rename("tables/a", "tables/b")
    assert option_files(asked)["tables"] != seen[0]["tables"]
    Path("weights.npz").unlink()
    assert option_files(asked)["weights.npz"] == ""


def test_what_a_part_writes_is_not_what_it_reads(part: Path) -> None:
    Path("log").mkdir()
    asked = Part(
        part=f"{part}:Planner", label="", kind="planner", options={"weights": "log"}
    )
    assert set(option_files(asked)) == {"log"}
    part.write_text(
        PART.replace("class Planner:\n", "class Planner:\n    writes = ('weights',)\n")
    )
    assert option_files(asked) == {}


@pytest.mark.parametrize("folder", [".", "..", "/"])
def test_a_folder_that_holds_the_working_folder_is_refused(
    part: Path, folder: str
) -> None:
    asked = Part(
        part=f"{part}:Planner", label="", kind="planner", options={"weights": folder}
    )
    assert f"a folder around the working folder, got {folder!r}" in refusal(
        lambda: option_files(asked)
    )


MOVED = {
    "from benchnav.planning.risk import cvar": "benchnav.planning.risk.cvar is now benchnav.planning.CVaR.",
    "from benchnav.planning.risk import mean, var": "benchnav.planning.risk.mean is now benchnav.planning.Mean.",
}


@pytest.mark.parametrize(("line", "remedy"), MOVED.items())
def test_a_name_of_an_earlier_version_is_answered_with_that_of_today(
    line: str, remedy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "old_part.py").write_text(
        f"import math\n{line}\n\n\nclass Mine:\n    pass\n"
    )
    for source in (f"{tmp_path / 'old_part.py'}:Mine", "old_part:Mine"):
        with pytest.raises(ConfigError) as caught:
            find("planner", source)
        assert remedy in str(caught.value)
        assert "\n" not in str(caught.value)
    assert "old_part.py could not be imported" in str(
        caught.value
    ) or "got old_part: " in str(caught.value)


def test_the_new_names_can_be_imported() -> None:
    for old, new in IMPORTS.items():
        place, _, name = new.rpartition(".")
        assert hasattr(
            importlib.import_module(place), name
        ) or importlib.util.find_spec(new), old


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package in place of this one: `unit` imports `rows`, late; nothing imports
    `drawing`.
    """
    place = tmp_path / "benchnav"
    place.mkdir()
    (place / "__init__.py").write_text("from benchnav import drawing\n")
    (place / "unit.py").write_text(
        "import aid\n\ndef run():\n    from benchnav import rows\n    return rows\n"
    )
    (tmp_path / "aid.py").write_text("")
    (place / "rows.py").write_text(
        '"""Rows."""\n\n\ndef row():\n    """One row."""\n    return 1  # of many\n'
    )
    (place / "drawing.py").write_text("colour = 'blue'\n")
    monkeypatch.setattr(sources, "PACKAGE", place)
    yield place
    sources._digest_and_imports.cache_clear()


def digests() -> dict[str, str]:
    sources._digest_and_imports.cache_clear()  # as a new process
    return sources.digests_of_package_modules(["benchnav.unit"])


def test_modules_of_the_package_are_those_that_a_unit_imports(package: Path) -> None:
    assert list(digests()) == ["benchnav.rows", "benchnav.unit"]


def test_docstrings_comments_and_layout_change_no_module_digest_and_code_does(
    package: Path,
) -> None:
    before, rows = digests(), package / "rows.py"
    rows.write_text(
        'def row():\n    """The one row, in other words."""\n\n    return (\n        1\n    )\n'
    )
    assert digests() == before
    rows.write_text(rows.read_text().replace("1", "2"))
    after = digests()
    assert after["benchnav.rows"] != before["benchnav.rows"]
    assert after["benchnav.unit"] == before["benchnav.unit"]
