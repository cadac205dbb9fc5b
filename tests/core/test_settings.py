"""Settings by type: what becomes of plain data, which key a message names, and the way
back.
"""

# ruff: noqa: E501 - each message stands on one line, as users see it

import json
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.settings import (
    NO_DEFAULT,
    changed,
    hint,
    in_words,
    list_options,
    of,
    plain,
    read,
    read_options,
)


@dataclass(frozen=True, kw_only=True)
class Wheel:
    radius_m: float
    kind: Literal["rigid", "soft"] = "rigid"

    def __post_init__(self) -> None:
        if self.radius_m <= 0:
            raise ConfigError(f"Expected `radius_m` > 0, got {self.radius_m}.")


@dataclass(frozen=True, kw_only=True)
class Rover:
    name: str
    wheels: tuple[Wheel, ...] = ()
    spare: Wheel | None = None
    speeds: dict[str, Wheel] = field(default_factory=dict)
    path: tuple[float, float] = (0.0, 0.0)
    notes: dict[str, Any] = field(default_factory=dict)


FULL = {
    "name": "r",
    "wheels": [{"radius_m": 1}, {"radius_m": 2.5, "kind": "soft"}],
    "spare": {"radius_m": 0.5},
    "speeds": {"slow": {"radius_m": 3}},
    "path": [1, 2],
    "notes": {"a": [1, None]},
}


def rover(data: Any, now: Any = None) -> Any:
    return read(Rover, data, of("rover"), present=now)


def test_plain_data_becomes_nested_dataclasses_and_comes_back() -> None:
    made = rover(json.loads(json.dumps(FULL)))
    assert made == Rover(
        name="r",
        wheels=(Wheel(radius_m=1.0), Wheel(radius_m=2.5, kind="soft")),
        spare=Wheel(radius_m=0.5),
        speeds={"slow": Wheel(radius_m=3.0)},
        path=(1.0, 2.0),
        notes={"a": [1, None]},
    )
    assert isinstance(made.wheels[0].radius_m, float)
    assert rover(json.loads(json.dumps(plain(made)))) == made
    assert rover(made) is made


def test_what_is_not_given_stays_as_it_is_in_the_value_that_is_changed() -> None:
    whole = rover(FULL)
    assert rover({"path": "3,4"}, whole) == rover(FULL | {"path": [3, 4]})
    assert rover({"spare": {"kind": "soft"}}, whole).spare == Wheel(
        radius_m=0.5, kind="soft"
    )
    assert rover({"spare": None}, whole).spare is None
    assert rover({}, whole) == whole


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": 3}, "Expected `name` of rover as text, got 3."),
        ({"name": None}, "Expected `name` of rover as text, got null."),
        ({"nmae": "x"}, "Expected keys of rover among name, wheels, spare, speeds, path, notes, got 'nmae'. Did you mean 'name'?"),
        ({3: "x"}, "Expected keys of rover among name, wheels, spare, speeds, path, notes, got '3'."),
        ({"wheels": [{"radius_m": "x"}]}, "Expected `wheels.0.radius_m` of rover as a number, got 'x'."),
        ({"wheels": [{}]}, "Expected `wheels.0.radius_m` of rover as a number, got none."),
        ({"wheels": [None]}, "Expected `wheels.0` of rover as a mapping, got null."),
        ({"wheels": 3}, "Expected `wheels` of rover as a list, each a mapping, got 3."),
        ({"wheels": [{"radius_m": -1}]}, "Expected `radius_m` > 0, got -1.0."),
        ({"spare": {"radius_m": 1, "kind": "sotf"}}, "Expected `spare.kind` of rover as 'rigid' or 'soft', got 'sotf'. Did you mean 'soft'?"),
        ({"spare": [1]}, "Expected `spare` of rover as a mapping or null, got [1]."),
        ({"speeds": {"slow": {"radius": 1}}}, "Expected keys of `speeds.slow` of rover among radius_m, kind, got 'radius'. Did you mean 'radius_m'?"),
        ({"speeds": {1: {"radius_m": 1}}}, "Expected keys of `speeds` of rover as text, got [1]. Put numbers in quotes."),
        ({"path": [1]}, "Expected `path` of rover as a list [a number, a number], got [1]."),
        ({"path": [1, True]}, "Expected `path` of rover as a list [a number, a number], got [1, True]."),
        ({"notes": 3}, "Expected `notes` of rover as a mapping, got 3."),
    ],
)  # fmt: skip
def test_a_message_names_the_key_what_was_expected_and_what_came(
    change: dict[Any, Any], message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        rover(FULL | change)
    assert str(caught.value) == message


@pytest.mark.parametrize("value", [3, "3", "x", [1], True, None])
def test_only_a_mapping_is_a_dataclass_even_where_all_has_defaults(value: Any) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Easy:
        a: int = 1

    for now in (NO_DEFAULT, Easy(a=2)):
        with pytest.raises(ConfigError, match=r"^Expected easy as a mapping, got"):
            read(Easy, value, of("easy"), present=now)
        if value is not None:
            with pytest.raises(
                ConfigError, match=r"^Expected easy as a mapping or null, got"
            ):
                read(Easy | None, value, of("easy"), present=now)


def test_a_default_of_none_may_be_given_whatever_the_type_says() -> None:
    def part(limit: float = None, count: int = 1) -> None:  # type: ignore[assignment]  # noqa: RUF013 - as users write it
        pass

    assert read_options(list_options(part), {"limit": None}, of("part")) == {
        "limit": None
    }
    with pytest.raises(
        ConfigError, match="Expected `count` of part as a whole number, got null"
    ):
        read_options(list_options(part), {"count": None}, of("part"))


def test_a_value_is_set_in_a_copy_of_plain_data() -> None:
    data = {
        "a": {"b": 1},
        "items": [{"name": "x", "n": 1}, {"name": "y", "n": 2}],
        "row": [1, 2],
    }
    before = json.dumps(data)
    assert changed(data, ["a", "b"], 2)["a"] == {"b": 2}
    assert changed(data, ["new", "deep"], 2)["new"] == {"deep": 2}
    assert changed(data, ["items", "y", "n"], 3)["items"] == [
        {"name": "x", "n": 1},
        {"name": "y", "n": 3},
    ]
    assert changed(data, ["row", "1"], 3)["row"] == [1, 3]
    assert changed(None, ["a"], 1) == {"a": 1}
    assert json.dumps(data) == before
    with pytest.raises(ConfigError, match=r"Expected a name among x, y, got 'z'\."):
        changed(data, ["items", "z", "n"], 3)
    with pytest.raises(
        ConfigError, match=r"Expected a mapping in which 'c\.d' can be set, got 1"
    ):
        changed(data, ["a", "b", "c", "d"], 3)


def test_plain_data_is_what_json_reads_back() -> None:
    class Colour(Enum):
        RED = 1

    given = {
        "colour": Colour.RED,
        3: (Path("a/b"), None, True, 1.5),
        "wheel": Wheel(radius_m=1.0),
    }
    wanted = {
        "colour": "RED",
        "3": ["a/b", None, True, 1.5],
        "wheel": {"radius_m": 1.0, "kind": "rigid"},
    }
    assert plain(given) == wanted == json.loads(json.dumps(plain(given)))
    with pytest.raises(ConfigError, match="Expected plain data"):
        plain({"a": print})


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (int | None, "a whole number or null"),
        (list[int], "a list, each a whole number"),
        (tuple[float, ...], "a list, each a number"),
        (tuple[str, int], "a list [text, a whole number]"),
        (str | dict[str, Any], "text or a mapping"),
        (Literal["a", "b"], "'a' or 'b'"),
        (Wheel | None, "a mapping or null"),
        (bool, "true or false"),
        (list, "list"),
        (Any, "anything"),
    ],
)
def test_types_are_told_in_words(kind: Any, words: str) -> None:
    assert in_words(kind) == words


def test_a_hint_is_the_nearest_known_name() -> None:
    assert hint("instances", ["planners"]) == ""
    assert hint("planer", ["planners"], "--") == " Did you mean '--planners'?"
