"""Studies and their parts, read from `study.yaml`.

A study has parts. A part is a suite, which is run into a folder, or a script of the
study, which computes tables and figures. A suite whose digest is printed on a page must
not change, so its paths are those of the time when it was fixed. `moved` maps them to
current paths, which replace them when the suite is run.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from benchnav.core.errors import choose, expect
from benchnav.core.settings import of, read
from benchnav.eval.cli import SUITES

ROOT = Path(__file__).parents[1]
HOME = ROOT / "studies"

# Rows of a table; each maps headings to cells.
Rows = list[dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Work:
    """Folders and extent of the work on a study.

    Args:
        out: folder of the runs.
        maps_in: folder of the maps.
        maps: number of maps per condition, from the first; if 0, that of the suites.
        jobs: number of processes.
    """

    out: Path
    maps_in: Path
    maps: int = 0
    jobs: int = 2


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a study.

    Args:
        suite: name of a suite in the study's folder or of a shipped one; if empty, the
            part's name.
        script: `MODULE:FUNCTION` in the study's folder, instead of a suite; called with
            the `Work`, the run's folder and the options, it returns figures and tables
            (rows or Markdown) by name.
        options: options of the script.
        run: name of the run; if empty, `STUDY-PART`.
        maps: number of maps per condition, from the first; if 0, that of the suite.
    """

    suite: str = ""
    script: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    run: str = ""
    maps: int = 0


@dataclass(frozen=True, kw_only=True)
class Maps:
    """Dataset of a study.

    Args:
        create: arguments of `benchnav-datagen create`.
        splits: splits to create; the digest is that of the first.
        digest: digest of the content; if empty, not checked.
    """

    create: tuple[str, ...]
    splits: tuple[str, ...] = ("test/std",)
    digest: str = ""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """Source of a figure of the page: a file to copy, or a function that draws it.

    Args:
        copy: path of a figure in the folder of the runs; if empty, it is drawn.
        draw: `MODULE:FUNCTION` in the study's folder; called with the rows of the
            parts' summaries, it returns the figure.
        parts: parts whose summaries are passed to `draw`.
    """

    copy: str = ""
    draw: str = ""
    parts: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Study:
    """Study with its parts, maps, tables and figures.

    Args:
        folder: folder of its files; the folder's name is that of the study.
        page: path of the page with its tables, from the root of the repository.
        parts: parts by name, in the order in which they are run.
        maps: datasets by file name without suffix.
        moved: current paths of files, by their paths in fixed suites.
        develop: dataset on which hypotheses were developed; empty without hypotheses.
        seed: seed of the episodes on the development maps.
        tables: `MODULE:FUNCTION` in the study's folder, by kind of table; called with a
            run's folder, the function returns the table.
        figures: figures of the page, by file name in docs/figures.
    """

    folder: Path
    page: str
    parts: dict[str, Part]
    maps: dict[str, Maps] = field(default_factory=dict)
    moved: dict[str, str] = field(default_factory=dict)
    develop: str = ""
    seed: int = 1
    tables: dict[str, str] = field(default_factory=dict)
    figures: dict[str, Drawing] = field(default_factory=dict)

    @classmethod
    def load(cls, name: str) -> "Study":
        """Read a study, given its name or its folder.

        Raises:
            ConfigError: If there is no such study, or its file is invalid.
        """
        folder = next(
            (
                path
                for path in (HOME / name, Path(name))
                if (path / "study.yaml").is_file()
            ),
            None,
        )
        names = sorted(path.parent.name for path in HOME.glob("*/study.yaml"))
        expect(
            folder,
            f"`study` among {', '.join(names)}, or a folder that has a study.yaml, got "
            f"{name}.",
        )
        assert folder is not None
        data = yaml.safe_load((folder / "study.yaml").read_text())
        # A part without settings is the suite of the same name.
        data["parts"] = {part: options or {} for part, options in data["parts"].items()}
        study: Study = read(
            cls,
            data | {"folder": str(folder.resolve())},
            of(str(folder / "study.yaml")),
        )
        return study

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.folder.name

    def choose(self, parts: Sequence[str]) -> list[str]:
        """Return these parts in the order of the study, or all if `parts` is empty.

        Raises:
            ConfigError: If the study has no such part.
        """
        return choose("parts", parts or None, self.parts)

    def run_of(self, part: str) -> str:
        """Return the name of a part's run."""
        return self.parts[part].run or f"{self.name}-{part}"

    def suite_of(self, part: str) -> Path:
        """Return the file of a part's suite."""
        name = self.parts[part].suite or part
        path = self.folder / f"{name}.yaml"
        return path if path.is_file() else SUITES / f"{name}.yaml"

    def suite(self, part: str, work: Work) -> dict[str, Any]:
        """Return a part's suite as it is run, with the paths of maps and moved files."""
        content: dict[str, Any] = yaml.safe_load(self.suite_of(part).read_text())
        suite: dict[str, Any] = self._placed(content, work)
        maps = work.maps or self.parts[part].maps
        return suite | ({"maps": maps} if maps else {})

    def _placed(self, value: Any, work: Work, key: str = "") -> Any:
        if isinstance(value, Mapping):
            return {
                name: self._placed(item, work, name) for name, item in value.items()
            }
        if isinstance(value, list):
            return [self._placed(item, work, key) for item in value]
        if key == "data" and value in self.maps:
            return str(work.maps_in / f"{value}.h5")
        if key == "part":
            path, colon, name = value.partition(":")
            return f"{self.moved.get(path, path)}{colon}{name}"
        return value

    def function(self, name: str) -> Callable[..., Any]:
        """Import a function of the study, given as `MODULE:FUNCTION`."""
        module_name, _, function_name = name.partition(":")
        module = importlib.import_module(f"studies.{self.name}.{module_name}")
        function: Callable[..., Any] = getattr(module, function_name)
        return function
