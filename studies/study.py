"""What a study consists of, as its file `study.yaml` says.

A study has parts. A part is a suite, which is run into a folder, or a script of the
study, which computes tables and figures. Suites whose digest stands on a page keep
their bytes: paths in them are those of the day when they were fixed. `moved` says where
such a file is today, and the suite that is run names that.
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

# Rows of a table: cells by heading.
Rows = list[dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Work:
    """Where a study is run, and how much of it.

    Args:
        out: folder of the runs.
        maps_in: folder of the maps.
        maps: number of maps of each condition, the first ones; if 0, as the suites say.
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
        suite: name of its suite in the study's folder, or of a shipped one; if empty,
            the part's name.
        script: `MODULE:FUNCTION` of the study's folder, in place of a suite; called
            with the `Work`, the run's folder and the options, it returns figures,
            tables (rows or Markdown) by name.
        options: of the script.
        run: name of the run; if empty, `STUDY-PART`.
        maps: number of maps of each condition, the first ones; if 0, as the suite says.
    """

    suite: str = ""
    script: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    run: str = ""
    maps: int = 0


@dataclass(frozen=True, kw_only=True)
class Maps:
    """Maps of a study.

    Args:
        create: words of `benchnav-datagen create`.
        splits: the splits to make; the digest is of the first.
        digest: of the content; if empty, any.
    """

    create: tuple[str, ...]
    splits: tuple[str, ...] = ("test/std",)
    digest: str = ""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """How a figure of the page comes about.

    Args:
        copy: path of a figure in the folder of the runs; empty where it is drawn.
        draw: `MODULE:FUNCTION` of the study's folder; called with the rows of all
            summaries, it returns the figure.
        parts: parts whose summaries it is given.
    """

    copy: str = ""
    draw: str = ""
    parts: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study.

    Args:
        folder: where its files lie; its name is the study's.
        page: path of the page with its tables, from the root of the repository.
        parts: parts by name, in the order in which they are run.
        maps: maps by name of their file.
        moved: path of today by a path in a suite that was fixed before.
        develop: maps on which its hypotheses were developed; empty where it has none.
        seed: of the episodes there.
        tables: `MODULE:FUNCTION` of the study's folder by kind of table; it makes one
            of a run's folder.
        figures: figures of the page by name of their file in docs/figures.
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
        """Read a study by its name, or by its folder.

        Raises:
            ConfigError: If there is no such study, or its file is not usable.
        """
        folder = next(
            (
                path
                for path in (HOME / name, Path(name))
                if (path / "study.yaml").is_file()
            ),
            None,
        )
        known = sorted(path.parent.name for path in HOME.glob("*/study.yaml"))
        expect(
            folder,
            f"`study` among {', '.join(known)}, or a folder with a study.yaml, got "
            f"{name}.",
        )
        assert folder is not None
        data = yaml.safe_load((folder / "study.yaml").read_text())
        # A part that says nothing is the suite of its name.
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
        """Return these parts, or all if none is named, in the order of the study.

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
        own = self.folder / f"{name}.yaml"
        return own if own.is_file() else SUITES / f"{name}.yaml"

    def suite(self, part: str, work: Work) -> dict[str, Any]:
        """Return a part's suite as it is run: with maps by their files, and files where
        they are today.
        """
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
        """Return a function of the study, from `MODULE:FUNCTION`."""
        module, _, function = name.partition(":")
        found: Callable[..., Any] = getattr(
            importlib.import_module(f"studies.{self.name}.{module}"), function
        )
        return found
