"""YAML that users write: numbers, and what is refused before anything is built of it."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.core.errors import ConfigError
from benchnav.core.yaml_text import MAX_DEPTH, MAX_VALUES, load_yaml, read_yaml

KEYS = st.from_regex(r"k[a-z0-9]{0,4}", fullmatch=True)
DATA = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | KEYS,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4)
    ),
    max_leaves=20,
)


def test_yaml_has_numbers_with_exponents_and_mappings_without_values(
    tmp_path: Path,
) -> None:
    assert load_yaml("{a: 1e-3, b: yes, c: 2024-01-01}") == {
        "a": 0.001,
        "b": True,
        "c": "2024-01-01",
    }
    assert load_yaml("a:\n") == {"a": None}
    assert load_yaml("{0: null}") == {0: None}
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\nb: [\n")
    with pytest.raises(
        ConfigError, match=r"^Expected YAML, got .*a.yaml, line 3: did not find"
    ):
        read_yaml(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"a\.yaml': it is not text"):
        read_yaml(path)
    with pytest.raises(ConfigError, match="Is a directory"):
        read_yaml(tmp_path)


@settings(deadline=None)
@given(DATA)
def test_what_is_written_as_yaml_is_read_back(data: Any) -> None:
    assert load_yaml(yaml.safe_dump(data)) == data


@settings(deadline=None)
@given(st.dictionaries(KEYS, st.integers(), min_size=1, max_size=6), st.data())
def test_a_key_twice_is_refused_wherever_it_stands(
    data: dict[str, int], draw: st.DataObject
) -> None:
    lines = yaml.safe_dump(data).splitlines()
    again = draw.draw(st.sampled_from(lines))
    lines.insert(draw.draw(st.integers(0, len(lines))), again)
    with pytest.raises(ConfigError, match="occurs twice"):
        load_yaml("\n".join(lines))
    inner = "\n".join(f"    {line}" for line in lines)
    with pytest.raises(ConfigError, match="occurs twice"):
        load_yaml(f"a:\n- b:\n{inner}\n")


def test_a_mapping_that_is_merged_into_others_has_its_keys_changed() -> None:
    text = "a: &a {k: 1, l: 2}\nb: &b {<<: *a, k: 3}\nc: {<<: *b, l: 4}\n"
    assert load_yaml(text)["c"] == {"k": 3, "l": 4}
    assert load_yaml("[&a [1, 2], *a, *a]") == [[1, 2]] * 3
    with pytest.raises(ConfigError, match="'<<' occurs twice"):
        load_yaml("a: &a {k: 1}\nb: {<<: *a, <<: *a}\n")


@pytest.mark.parametrize("pair", ["[]", "{}"])
def test_nesting_ends_at_a_limit(pair: str) -> None:
    def nested(depth: int) -> str:
        return (pair[0] + "a: " * (pair == "{}")) * depth + "1" + pair[1] * depth

    assert load_yaml(nested(MAX_DEPTH)) is not None
    for depth in (MAX_DEPTH + 1, 100_000):
        with pytest.raises(ConfigError, match="levels"):
            load_yaml(nested(depth))


def test_values_are_counted_with_what_aliases_stand_for() -> None:
    row = f"[{', '.join(['1'] * 99)}]"  # 100 values, and the outer list is one more
    few = f"[&a {row}{', *a' * (MAX_VALUES // 100 - 2)}]"
    assert len(load_yaml(few)) == MAX_VALUES // 100 - 1
    with pytest.raises(ConfigError, match="more than"):
        load_yaml(f"[&a {row}{', *a' * (MAX_VALUES // 100)}]")
    doubling = "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 200))
    with pytest.raises(ConfigError, match="more than"):
        load_yaml(f"a0: &a0 x\n{doubling}")


@pytest.mark.parametrize("text", ["&a [*a]", "&a {b: [{c: *a}]}", "[1, &b [&c [*b]]]"])
def test_an_alias_within_what_it_stands_for_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"\*\w is within &\w"):
        load_yaml(text)


@pytest.mark.parametrize(
    "text",
    ["!!python/object:os.system ls", "!mine 1", "!!set {a, b}", "!!binary aGk=", "!!timestamp 2001-01-01",
     "!!omap [a: 1]", "!!int many", "9" * 5000, "? [a]\n: 1", '"\\0"', '"\\e[31m"', '"\\udcff"', "a: *b"],
)  # fmt: skip
def test_what_is_no_plain_data_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        load_yaml(text)
