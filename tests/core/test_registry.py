"""The registry: each form of a name, options and their types, what is said of mistakes,
and digests.
"""

import contextlib
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from joblib import Parallel, delayed

from benchnav.core import part_lookup, registry
from benchnav.core.errors import ConfigError
from benchnav.core.registry import (
    Part,
    complete,
    find,
    make,
    names,
    options_of,
    read_part,
    register,
    take,
)
from benchnav.planning.planners.mppi import MPPI
from benchnav.planning.robots import Unicycle

SOURCE = """
from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from benchnav import planning

if TYPE_CHECKING:
    from nowhere import Robot


class _Planner(planning.Planner):
    init = plan = None


class _Robot(planning.Robot):
    dt_s = action_names = action_low = action_high = top_speed_mps = initial_state = __call__ = None


class _Objective(planning.Objective):
    stage = terminal = None


@dataclass(frozen=True, kw_only=True)
class Follower:
    gain: float = 2.0
    corners: int = 3


@dataclass(frozen=True, kw_only=True)
class Config:
    reach_m: float = 1.5
    follower: Follower = field(default_factory=Follower)
    second: Follower | None = None
    widths: tuple[float, ...] = (1.0, 2.0)

    def __post_init__(self):
        if self.reach_m <= 0:
            raise ValueError("reach is\\nnot positive")


class Planner(_Planner):
    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()


class Plain(_Planner):
    def __init__(
        self, count: int, mode: Literal["a", "b"] = "a", name: str = "x", limit: float | None = None,
        fast: bool = False, anything=None,
    ) -> None:
        self.given = (count, mode, name, limit, fast, anything)


class NeedsRobot(_Objective):
    def __init__(self, robot: Robot, margin_m: float = 0.5) -> None:
        self.robot, self.margin_m = robot, margin_m


@dataclass(frozen=True)
class Bare(_Objective):
    size: int = 4
    names: list[str] = field(default_factory=lambda: ["u"])


class NoOptions(_Planner):
    pass


class Holder:
    class Inner(_Robot):
        pass


class Odd(_Planner):
    def __init__(self, act=print) -> None:
        pass


def worst(mixture, share: float = 0.25, floor: float = 0.0):
    return mixture, share, floor


def robot():
    return Holder.Inner()


class Duck:
    def init(self, problem, generator): ...

    def plan(self, step, plan_state): ...


thing = Bare()
"""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A user's file, by its path from the working folder."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(SOURCE)
    return "./mine.py"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A user's package on the path, with an entry point in two groups, as an installed
    one has.
    """
    place = tmp_path / "site"
    (place / "plugged").mkdir(parents=True)
    (place / "plugged" / "__init__.py").write_text("")
    (place / "plugged" / "parts.py").write_text(SOURCE)
    info = place / "plugged_parts-3.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: plugged-parts\nVersion: 3.1\n"
    )
    (info / "top_level.txt").write_text("plugged\n")
    (info / "entry_points.txt").write_text(
        "[benchnav.planners]\nplugged = plugged.parts:Planner\nbroken = plugged.absent:Planner\n"
        "[benchnav.risks]\nworst = plugged.parts:worst\n"
    )
    monkeypatch.syspath_prepend(place)
    yield place
    for name in [name for name in sys.modules if name.partition(".")[0] == "plugged"]:
        del sys.modules[name]


@pytest.fixture(autouse=True)
def _unregistered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})


def refusal(call: Callable[[], object]) -> str:
    """What a call that must fail says, which has to be one line."""
    with pytest.raises(ConfigError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- the four forms ---


def test_a_shipped_name_is_found_and_its_value_sets_its_first_option() -> None:
    assert read_part("risk", "cvar") == Part(part="cvar", label="cvar")
    assert read_part("risk", "cvar:0.5") == Part(
        part="cvar", label="cvar:0.5", options={"level": 0.5}
    )
    found = find("risk", "cvar")
    assert (found.target.__name__, found.shipped, found.everywhere, found.digest) == (
        "CVaR",
        True,
        True,
        "",
    )
    assert found.origin == "benchnav"


def test_an_entry_point_of_an_installed_package_is_found(package: Path) -> None:
    assert "plugged" in names("planner")
    assert "plugged" not in names("risk")
    found = find("planner", "plugged")
    assert found.target.__name__ == "Planner"
    assert (found.origin, found.shipped, found.everywhere) == (
        "plugged-parts 3.1",
        False,
        True,
    )
    assert make("planner", "plugged:4").config.reach_m == 4
    assert make("risk", "worst:0.1")("mixture") == ("mixture", 0.1, 0.0)


def test_a_name_that_two_packages_have_is_refused(package: Path) -> None:
    other = package / "other-1.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (other / "entry_points.txt").write_text(
        "[benchnav.planners]\nplugged = other:Planner\n"
    )
    part_lookup._points_on.cache_clear()
    message = refusal(lambda: find("planner", "plugged"))
    assert "plugged.parts:Planner" in message
    assert "other:Planner" in message


@pytest.mark.parametrize(
    ("text", "label", "options"),
    [
        ("plugged.parts:worst", "worst", {}),
        ("plugged.parts:worst:0.5", "worst:0.5", {"share": 0.5}),
        ("plugged.parts:worst:1", "worst:1", {"share": 1.0}),
    ],
)
def test_a_part_of_a_module_is_found(
    package: Path, text: str, label: str, options: dict[str, float]
) -> None:
    part = read_part("risk", text)
    assert part == Part(part="plugged.parts:worst", label=label, options=options)
    found = find("risk", part.part)
    assert (found.origin, found.shipped, found.everywhere) == (
        "plugged-parts 3.1",
        False,
        True,
    )
    assert make("risk", text)("m") == ("m", options.get("share", 0.25), 0.0)


def test_a_part_of_this_package_may_be_named_by_its_module_and_a_class_within_a_class(
    package: Path,
) -> None:
    assert find("risk", "benchnav.planning.risk:Mean").shipped
    assert (
        type(make("robot", "plugged.parts:Holder.Inner")).__qualname__ == "Holder.Inner"
    )


def test_a_part_of_a_file_is_found(file: str) -> None:
    assert read_part("risk", f"{file}:worst") == Part(
        part="./mine.py:worst", label="worst"
    )
    part = read_part("risk", f"{file}:worst:0.5")
    assert part == Part(
        part="./mine.py:worst", label="worst:0.5", options={"share": 0.5}
    )
    found = find("risk", part.part)
    assert (found.origin, found.shipped, found.everywhere) == (
        "file mine.py",
        False,
        True,
    )
    assert make("risk", part)("m") == ("m", 0.5, 0.0)
    assert make("risk", Path("mine.py").absolute().as_posix() + ":worst")("m") == (
        "m",
        0.25,
        0.0,
    )
    assert not list(Path().rglob("*.pyc"))


def test_what_is_registered_is_known_in_this_process_alone() -> None:
    class Mine(MPPI):
        def __init__(self, speed: float = 1.0) -> None:
            self.speed = speed

    register("planner", "mine", Mine)
    assert "mine" in names("planner")
    assert "mine" not in names("robot")
    assert make("planner", "mine:2").speed == 2
    found = find("planner", "mine")
    assert (found.everywhere, found.shipped, found.origin) == (
        False,
        False,
        "this process",
    )
    assert found.digest


def test_parts_are_written_as_text_or_as_mappings(file: str) -> None:
    given = {"part": f"{file}:worst", "label": "mine", "options": {"floor": 0.1}}
    part = read_part("risk", given)
    assert part == Part(part="./mine.py:worst", label="mine", options={"floor": 0.1})
    assert read_part("risk", part) is part
    assert given == {
        "part": f"{file}:worst",
        "label": "mine",
        "options": {"floor": 0.1},
    }
    both = read_part(
        "risk", {"part": f"{file}:worst:0.5", "label": None, "options": {"floor": 0.1}}
    )
    assert (both.options, both.label) == ({"share": 0.5, "floor": 0.1}, "worst:0.5")


@pytest.mark.parametrize(
    "given",
    [
        {"planner": "x"},
        {"part": "mppi", "option": {}},
        {"part": 3},
        {"part": "mppi", "options": [1]},
        ["mppi"],
        3,
        None,
    ],
)
def test_anything_else_is_no_part(given: object) -> None:
    assert "{part: NAME, label: LABEL" in refusal(lambda: read_part("planner", given))  # type: ignore[arg-type]


# --- options ---


def test_options_are_parameters_of_a_function_class_or_dataclass_and_fields_of_a_config(
    file: str,
) -> None:
    def listed(kind: str, name: str) -> dict[str, object]:
        return {
            n: option.default
            for n, option in options_of(
                kind, find(kind, f"{file}:{name}").target
            ).items()
        }

    assert listed("risk", "worst") == {"share": 0.25, "floor": 0.0}
    assert listed("robot", "robot") == {}
    assert listed("planner", "NoOptions") == {}
    assert listed("planner", "Plain") == {
        "count": registry.NO_DEFAULT, "mode": "a", "name": "x", "limit": None, "fast": False, "anything": None
    }  # fmt: skip
    assert list(listed("planner", "Planner")) == [
        "reach_m",
        "follower",
        "second",
        "widths",
    ]
    assert listed("robot", "Bare") == {"size": 4, "names": ["u"]}
    assert listed("objective", "NeedsRobot") == {"margin_m": 0.5}


def test_types_are_known_even_where_one_is_imported_for_type_checkers_alone(
    file: str,
) -> None:
    target = find("objective", f"{file}:NeedsRobot").target
    assert options_of("objective", target)["margin_m"].kind is float


def test_a_part_is_made_with_its_options(file: str) -> None:
    given = {
        "reach_m": 2,
        "follower": {"gain": 5},
        "widths": [3, 4],
        "second": {"corners": 1},
    }
    config = make("planner", {"part": f"{file}:Planner", "options": given}).config
    assert (config.reach_m, config.widths) == (2.0, (3.0, 4.0))
    assert (config.follower.gain, config.follower.corners) == (5.0, 3)
    assert (config.second.gain, config.second.corners) == (2.0, 1)
    assert isinstance(config.reach_m, float)
    assert isinstance(config.widths, tuple)
    plain = {
        "count": 1,
        "mode": "b",
        "name": "y",
        "limit": 0.5,
        "fast": True,
        "anything": [1],
    }
    assert make("planner", {"part": f"{file}:Plain", "options": plain}).given == tuple(
        plain.values()
    )
    assert type(make("robot", f"{file}:robot")).__name__ == "Inner"


@pytest.mark.parametrize(
    ("kind", "place", "base"),
    [
        ("planner", "planning", "Planner"),
        ("robot", "planning", "Robot"),
        ("objective", "planning", "Objective"),
        ("model", "models", "TraversabilityModel"),
    ],
)
def test_what_is_no_subclass_is_refused_with_the_base_class_and_where_it_is(
    file: str, kind: str, place: str, base: str
) -> None:
    rest = f"to be an instance of benchnav.{place}.{base}, got Duck. Write class Duck({base})."
    assert (
        refusal(lambda: make(kind, f"{file}:Duck"))
        == f"Expected {kind} './mine.py:Duck' {rest}"
    )
    duck = find("planner", f"{file}:Duck").target()
    assert refusal(lambda: take(kind, duck)) == f"Expected the {kind} {rest}"


def test_a_part_is_taken_as_it_is_or_made_by_its_name() -> None:
    robot = Unicycle()
    assert take("robot", robot) is robot
    assert take("robot", {"part": "unicycle", "options": {"dt_s": 0.2}}).dt_s == 0.2
    assert (
        take("objective", "travel_time", robot=robot, goal_radius_m=1.0).robot is robot
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [("0.5", 0.5), ("1e-3", 0.001), ("3", 3), ("true", True), ("far", "far")],
)
def test_a_value_for_an_option_without_a_type_is_what_it_looks_like(
    text: str, value: object
) -> None:
    register("risk", "untyped", lambda mixture, share=0.25: share)
    found = make("risk", f"untyped:{text}")(None)
    assert found == value
    assert type(found) is type(value)


def test_what_a_part_is_made_for_is_given_where_it_is_asked_for(file: str) -> None:
    made = make("objective", f"{file}:NeedsRobot:0.2", robot="the robot")
    assert (made.robot, made.margin_m) == ("the robot", 0.2)
    assert make("objective", f"{file}:Bare", robot="the robot").size == 4


def test_complete_fills_in_defaults_as_plain_data_so_that_like_parts_are_alike(
    file: str,
) -> None:
    part = complete("planner", read_part("planner", f"{file}:Planner"))
    follower = {"gain": 2.0, "corners": 3}
    assert part.options == {
        "reach_m": 1.5,
        "follower": follower,
        "second": None,
        "widths": [1.0, 2.0],
    }
    written = {"reach_m": 1.5, "follower": {"gain": 2}, "widths": [1, 2]}
    again = complete(
        "planner", read_part("planner", {"part": f"{file}:Planner", "options": written})
    )
    assert again.options == part.options
    assert isinstance(again.options["follower"]["gain"], float)
    assert (
        complete("risk", read_part("risk", "cvar")).options
        == complete("risk", read_part("risk", "cvar:0.9")).options
    )


def test_options_that_came_later_are_left_out_at_their_default(tmp_path: Path) -> None:
    path = tmp_path / "later.py"
    path.write_text(
        "from dataclasses import dataclass\n\n@dataclass\nclass Config:\n    added = ('extra',)\n"
        "    first: float = 1.0\n    extra: float = 2.0\n\nclass Planner:\n"
        "    def __init__(self, config: Config):\n        self.config = config\n\n"
        "class Plain:\n    added = ('extra',)\n    def __init__(self, extra: int = 3): ...\n"
    )

    def options(name: str, **given: object) -> object:
        return complete(
            "planner",
            read_part("planner", {"part": f"{path}:{name}", "options": given}),
        ).options

    assert options("Planner") == options("Planner", extra=2) == {"first": 1.0}
    assert options("Planner", extra=2.5) == {"first": 1.0, "extra": 2.5}
    assert options("Plain", extra=3) == {}
    assert options("Plain", extra=4) == {"extra": 4}


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("Plain", {"count": True}, "`count` of planner './mine.py:Plain' as a whole number, got True"),
        ("Plain", {"count": 1.5}, "as a whole number, got 1.5"),
        ("Plain", {"count": "many"}, "as a whole number, got 'many'"),
        ("Plain", {"count": 1, "limit": "far"}, "`limit` of planner './mine.py:Plain' as a number or null, got"),
        ("Plain", {"count": 1, "limit": True}, "got True"),
        ("Plain", {"count": 1, "fast": 1}, "`fast` of planner './mine.py:Plain' as true or false, got 1"),
        ("Plain", {"count": 1, "mode": "c"}, "`mode` of planner './mine.py:Plain' as 'a' or 'b', got 'c'"),
        ("Plain", {"count": 1, "name": 5}, "as text, got 5"),
        ("Plain", {}, "`count` of planner './mine.py:Plain' as a whole number, got none"),
        ("Planner", {"widths": [1, "wide"]}, "as a list, each a number, got [1, 'wide']"),
        ("Planner", {"follower": 3}, "`follower` of planner './mine.py:Planner' as a mapping, got 3"),
        ("Planner", {"follower": {"gain": "much"}}, "`follower.gain` of planner './mine.py:Planner' as a number"),
        ("Planner", {"follower": {"gian": 1}}, "`follower` of planner './mine.py:Planner' among gain, corners, got"),
        ("Planner", {"second": {"corner": 1}}, "Did you mean 'corners'?"),
        ("Planner", {"reach": 1}, "among reach_m, follower, second, widths, got 'reach'. Did you mean 'reach_m'?"),
        ("Planner", {3: 1}, "got '3'"),
        ("NoOptions", {"reach": 1}, "Expected no options for"),
        ("Odd", {}, "Option 'act' of planner './mine.py:Odd' cannot be recorded"),
    ],
)  # fmt: skip
def test_options_that_are_wrong_are_refused(
    file: str, name: str, options: dict[str, object], expected: str
) -> None:
    part = read_part("planner", {"part": f"{file}:{name}", "options": options})
    assert expected in refusal(lambda: complete("planner", part))
    assert expected in refusal(lambda: make("planner", part))


def test_what_a_part_says_of_its_options_is_told_in_one_line(file: str) -> None:
    message = refusal(lambda: make("planner", f"{file}:Planner:-1"))
    assert (
        message
        == "options of planner './mine.py:Planner' could not be created: ValueError: reach is not positive"
    )
    assert "Expected `dt_s` > 0" in refusal(
        lambda: make("robot", {"part": "unicycle", "options": {"dt_s": 0}})
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("cvar:half", "Expected `level` of risk 'cvar' as a number, got 'half'."),
        ("cvar:", "got ''"),
        (
            "mean:0.5",
            "Expected risk 'mean' without a value, got 'mean:0.5'. This risk has no",
        ),
        ("cvarr:0.5", "Did you mean 'cvar'?"),
        ("cvarr:half", "Did you mean 'cvar'?"),
    ],
)
def test_values_after_a_name_that_do_not_fit_are_refused(
    text: str, expected: str
) -> None:
    assert expected in refusal(lambda: make("risk", text))


def test_an_option_given_twice_is_refused() -> None:
    given = {"part": "cvar:0.5", "options": {"level": 0.9}}
    assert "option 'level' of risk 'cvar:0.5' once" in refusal(
        lambda: read_part("risk", given)
    )


# --- what is not there ---


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("mpi", "Did you mean 'mppi'?"),
        ("optimal_bound", "It is now 'near_optimal'."),
        ("mine", "Did you mean './mine.py:Name'?"),
        ("./mine.py", "Name a class or function in the file: ./mine.py:Name."),
        ("mine:Planner", "Did you mean './mine.py:Planner'?"),
        (
            "./mien.py:Planner",
            "cannot be read: No such file or directory. Did you mean 'mine.py'?",
        ),
        ("./mine.py:Plannr", "Did you mean 'Planner'?"),
        ("./mine.py:thing", "got 'thing', which is an object of Bare"),
        ("nowhere.at.all:Planner", "there is no module 'nowhere'"),
        ("json:JSONEncode", "Did you mean 'JSONEncoder'?"),
        ("broken", "there is no module 'plugged.absent'"),
        ("..x:Y", "can be imported"),
        ("", "Expected a planner among"),
    ],
)
def test_what_is_not_there_gets_a_hint(
    file: str, package: Path, name: str, expected: str
) -> None:
    assert expected in refusal(lambda: find("planner", name))


def test_an_unknown_kind_is_refused() -> None:
    assert "Did you mean 'planner'?" in refusal(lambda: names("planer"))


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (
            "x = 1\nraise RuntimeError('of no\\nuse')\n",
            "RuntimeError: of no use (line 2)",
        ),
        (
            "import absent_helper\n",
            "No module named 'absent_helper' (line 1). A file cannot import modules from its own folder",
        ),
        ("class :\n", "SyntaxError"),
        ("import sys\nsys.exit('done')\n", "SystemExit: done (line 2)"),
    ],
)
def test_a_file_or_module_that_raises_is_told_in_one_line(
    file: str, package: Path, source: str, expected: str
) -> None:
    Path("bad.py").write_text(source)
    message = refusal(lambda: find("planner", "./bad.py:Planner"))
    assert expected in message
    assert "bad.py could not be imported" in message
    assert not [name for name in sys.modules if name.startswith("benchnav_file_bad")]
    (package / "plugged" / "absent.py").write_text(source)
    importlib.invalidate_caches()
    assert expected.split(" (")[0] in refusal(lambda: find("planner", "broken"))


# --- files change, and their digests with them ---


def test_a_file_that_changed_is_loaded_anew_even_within_a_second(file: str) -> None:
    path, when = Path("part.py"), 1_700_000_000
    digests = set()
    for value in (1, 2, 3):
        path.write_text(f"def risk(mixture):\n    return {value}\n")
        os.utime(path, (when, when))  # same time, same size
        assert make("risk", "./part.py:risk")(None) == value
        digests.add(find("risk", "./part.py:risk").digest)
    assert len(digests) == 3
    path.write_text("def risk(mixture):\n    return 1\n")
    assert find("risk", "./part.py:risk").digest in digests
    assert make("risk", "./part.py:risk")(None) == 1


def test_two_files_of_one_stem_are_two_modules(file: str) -> None:
    for folder in ("a", "b"):
        Path(folder).mkdir()
        Path(folder, "part.py").write_text(
            "from pathlib import Path\n\n\nclass Robot:\n    place = Path(__file__)\n"
        )
    first, second = (find("robot", f"{folder}/part.py:Robot") for folder in ("a", "b"))
    assert first.digest == second.digest
    assert [one.target.place.parent.name for one in (first, second)] == ["a", "b"]
    assert sys.modules[first.target.__module__].Robot is first.target
    assert sys.modules[second.target.__module__].Robot is second.target
    assert find("robot", "a/part.py:Robot").target is first.target


def test_the_digest_of_a_package_covers_all_its_sources(package: Path) -> None:
    def digest() -> str:
        return find("planner", "plugged").digest

    before = digest()
    assert before == digest()
    helper = package / "plugged" / "deep" / "helper.py"
    helper.parent.mkdir()
    helper.write_text("x = 1\n")
    added = digest()
    helper.write_text("x = 2\n")
    changed = digest()
    helper.rename(helper.with_name("other.py"))
    assert len({before, added, changed, digest()}) == 4


def test_the_digest_of_a_module_is_that_of_its_file_and_of_where_the_part_is_defined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    base, front = tmp_path / "base_of_it.py", tmp_path / "front_of_it.py"
    front.write_text(
        "from base_of_it import Planner\nfrom benchnav.planning.risk import Mean\n"
    )
    seen = set()
    for content in ("class Planner:\n    a = 1\n", "class Planner:\n    a = 22\n"):
        base.write_text(content)
        for name in ("base_of_it", "front_of_it"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        seen.add(find("planner", "front_of_it:Planner").digest)
    assert len(seen) == 2
    found = find("risk", "front_of_it:Mean")
    assert (found.shipped, found.origin) == (False, "module front_of_it")


def test_the_digest_of_what_is_registered_is_that_of_its_source(file: str) -> None:
    digests = set()
    for value in (1, 2):
        Path("one.py").write_text(f"class Robot:\n    value = {value}\n")
        register("robot", "one", find("robot", "./one.py:Robot").target)
        digests.add(find("robot", "one").digest)
    assert len(digests) == 2
    register("robot", "none", dict)
    assert find("robot", "none").digest == ""


# --- other processes, and weight ---


def test_workers_find_parts_of_files_and_modules(
    file: str, package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(package))
    texts = ["./mine.py:Planner:3", "plugged.parts:Planner:3", "plugged:3"]
    # Workers may be older than this test: they are told where names of files and
    # packages begin.
    here = Path.cwd()
    made = Parallel(n_jobs=2)(
        delayed(_reach)(text, os.getpid(), here, package) for text in texts
    )
    assert made == [3.0, 3.0, 3.0]


def _reach(text: str, parent: int, here: Path, package: Path) -> float:
    assert os.getpid() != parent
    sys.path.insert(0, str(package))
    with contextlib.chdir(here):
        return float(make("planner", text).config.reach_m)


def test_the_registry_is_light_to_import() -> None:
    code = (
        "import sys, benchnav.core.registry as r; r.names('planner'); r.read_part('risk', 'cvar'); "
        "print(sorted({'torch', 'pandas', 'jsonargparse', 'joblib'} & set(sys.modules)))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == "[]"


@pytest.mark.parametrize("label", ["", " ", "a\nb", "a\x1b[31m", "\u202eb", ["a"]])
def test_a_label_is_printable_text(label: object) -> None:
    with pytest.raises(ConfigError, match="label"):
        registry.read_part("planner", {"part": "mppi", "label": label})
    assert (
        registry.read_part("planner", {"part": "mppi", "label": None}).label == "mppi"
    )
    assert registry.read_part("planner", {"part": "mppi", "label": 3}).label == "3"
