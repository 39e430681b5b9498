"""YAML in, plain data and line numbers out; and what may be done with plain data."""

import json
import math
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.documents import DEPTH, dotted, merge, one_line, plain, put, short
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.yaml_text import parse


def data(text: str) -> Any:
    return parse(text, "f.yaml")[0]


def refusal(text: str) -> str:
    with pytest.raises(ScenarioError) as error:
        parse(text, "f.yaml")
    return str(error.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("-17", -17),
        ("+3", 3),
        ("0", 0),
        ("1.5", 1.5),
        ("1.", 1.0),
        (".5", 0.5),
        ("1e-3", 1e-3),  # text to PyYAML
        ("1E+3", 1e3),
        ("-2.5e-7", -2.5e-7),
        ("010", 10.0),  # eight to PyYAML
        ("true", True),
        ("False", False),
        ("null", None),
        ("~", None),
        ("", None),
        ("on", "on"),  # true to PyYAML
        ("no", "no"),
        ("1:30", "1:30"),  # ninety to PyYAML
        ("2024-01-31", "2024-01-31"),  # a date to PyYAML
        ("0x10", "0x10"),
        ("1_000", "1_000"),
        ("=", "="),
        ("<<", "<<"),
        ("'1'", "1"),
        ("!!str 1", "1"),
        ("!!float 1", 1.0),
        ("[1, 2.0, [a]]", [1, 2.0, ["a"]]),
        ("{a: {b: [1]}}", {"a": {"b": [1]}}),
        ("a: &x [1]\nb: *x", {"a": [1], "b": [1]}),
        ("'ünï': 'cødé'", {"ünï": "cødé"}),
        ("\ufeffa: 1", {"a": 1}),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: Any) -> None:
    found = data(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("a:\tb\n\tc: d", 2, "tab"),
        ("a: 1\nb: [1,\n", 3, "flow node"),
        ("a: 1\na: 2", 2, "the key 'a' is given twice"),
        ("a:\n  b: 1\n  b: 2", 3, "the key 'b' is given twice"),
        ("a: 1\n2: 3", 2, "the key '2' must be plain text"),
        ("~: 1", 1, "must be plain text"),
        ("? [1, 2]\n: 3", 1, "must be plain text"),
        ("? {a: 1}\n: 3", 1, "must be plain text"),
        ("a: 1\n--- \nb: 2", 2, "another document"),
        ("a: *b", 1, "undefined alias"),
        ("a: 1\nb: .nan", 2, "b (=.nan): must be a finite number"),
        ("a:\n- 1\n- -.INF", 3, "a.1 (=-.INF): must be a finite number"),
        ("a: 1e999", 1, "a (=1e999): must be a finite number"),
        ("a: 1" + 350 * "0", 1, "must be a finite number"),
        ("a: 1" + 5000 * "0", 1, "must be a whole number"),
        ("a: !!int x", 1, "a (=x): must be a whole number"),
        ("a: !!float x", 1, "a (=x): must be a finite number"),
        ("a: !!bool maybe", 1, "a (=maybe): must be true or false"),
        ("a: !!int [1]", 1, "a: the tag !!int does not fit here"),
        ("a: !!map [1]", 1, "a: the tag !!map does not fit here"),
        ("a: !!set {b}", 1, "the tag !!set does not fit here"),
        ("a: !!binary aGk=", 1, "the tag !!binary does not fit here"),
        ("a: !!python/object/apply:os.system [ls]", 1, "does not fit here"),
        ("a: !own 1", 1, "the tag !own does not fit here"),
        ("- !!python/name:os.system", 1, "does not fit here"),
        ("a: &a [*a]", 1, "aliases"),
        ("a: &a {b: *a}", 1, "aliases"),
        ("a: &a\n  b: [1, *a]", 2, "aliases"),
        ("x: 1\na: " + 100_000 * "[", 2, "nests deeper than 50 levels"),
        ("a: " + 60 * "[" + 60 * "]", 1, "nests deeper than 50 levels"),
        ("a: " + 60 * "{a: " + "1" + 60 * "}", 1, "nests deeper than 50 levels"),
        ("".join(" " * i + "a:\n" for i in range(60)), 51, "nests deeper than 50 levels"),
        ("a: '\\ud800", 1, "quoted scalar"),
        ('a: "\\ud800"', 1, "Unicode"),
    ],
)
def test_a_refusal_names_file_and_line_in_one_line(text: str, line: int, words: str) -> None:
    message = refusal(text)
    assert message.startswith(f"f.yaml:{line}: ")
    assert words in message
    assert message.isprintable()
    assert len(message) < 300


@pytest.mark.parametrize("text", ["a: \x00", "a: \x07", "\udc80"])
def test_what_is_no_text_is_refused(text: str) -> None:
    message = refusal(text)
    assert message.startswith("f.yaml: not valid YAML")
    assert message.isprintable()


def test_an_alias_bomb_is_refused_quickly() -> None:
    bomb = "a: &a [x,x,x,x,x,x,x,x,x]\n"
    for name, last in zip("bcdefghi", "abcdefgh", strict=True):
        bomb += f"{name}: &{name} [{','.join(9 * ['*' + last])}]\n"
    assert "aliases" in refusal(bomb)


def test_a_chain_of_aliases_cannot_nest_deeper_than_text_can() -> None:
    chain = "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 2000))
    assert "aliases" in refusal(chain)


def test_every_key_and_item_has_its_line() -> None:
    _, lines = parse("a:\n  b: 1\n  c:\n  - x\n  - {d: 2,\n     e: 3}\n", "f.yaml")
    assert lines == {
        (): 1,
        ("a",): 1,
        ("a", "b"): 2,
        ("a", "c"): 3,
        ("a", "c", 0): 4,
        ("a", "c", 1): 5,
        ("a", "c", 1, "d"): 5,
        ("a", "c", 1, "e"): 6,
    }


def test_a_value_from_the_command_line_has_no_line() -> None:
    with pytest.raises(ScenarioError, match=r"^--set a: not valid YAML: while parsing a flow sequence"):
        parse("[1", "--set a", numbered=False)
    with pytest.raises(ScenarioError, match=r"^--set a \(=\.inf\): must be a finite number$"):
        parse(".inf", "--set a", numbered=False)


# YAML has no control characters and takes some line breaks for spaces
TEXT = st.text(st.characters(exclude_categories=["Cc", "Cs", "Zl", "Zp"], exclude_characters="\ufffe\uffff\ufeff"))
DATA: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(DATA)
def test_what_json_can_hold_is_read_back_unchanged(value: Any) -> None:
    assert data(json.dumps(value, ensure_ascii=False)) == value


@settings(deadline=None, derandomize=True, max_examples=200)
@given(DATA)
def test_what_yaml_writes_is_read_back_unchanged(value: Any) -> None:
    assert data(yaml.safe_dump(value, allow_unicode=True)) == value


@settings(deadline=None, derandomize=True, max_examples=400)
@given(st.text() | st.text(alphabet="ab:-?[]{}&*!|>'\"%@#,. \n\t~<=0123456789eE+", max_size=60))
def test_any_text_is_read_or_refused_in_one_line(text: str) -> None:
    read_or_refuse(text)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(st.binary())
def test_any_bytes_taken_for_text_are_read_or_refused(text: bytes) -> None:
    read_or_refuse(text.decode("latin-1"))


def read_or_refuse(text: str) -> None:
    message = ""
    try:
        json.dumps(data(text), allow_nan=False)
    except ScenarioError as error:
        message = str(error)
    assert message == "" or message.startswith("f.yaml")
    assert message.isprintable()


@pytest.mark.parametrize(
    ("value", "result"),
    [
        (np.float64(2.5), 2.5),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (np.array([[1.0, 2.0]]), [[1.0, 2.0]]),
        ((1, (2.0, "a")), [1, [2.0, "a"]]),
        ({"a": np.arange(2)}, {"a": [0, 1]}),
        (None, None),
        (True, True),
    ],
)
def test_values_from_python_become_plain_data(value: Any, result: Any) -> None:
    found = plain(value, "k")
    assert found == result
    assert type(found) is type(result)
    json.dumps(found)


def endless() -> list[Any]:
    inner: list[Any] = []
    inner.append(inner)
    return inner


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (math.nan, "k: must be a finite number"),
        (np.array([1.0, np.inf]), "k: must be a finite number"),
        (10**400, "k: must be a finite number"),
        (object(), "k: a object cannot stand"),
        ({1, 2}, "k: a set cannot stand"),
        (b"x", "k: a bytes cannot stand"),
        (1j, "k: a complex cannot stand"),
        ({1: 2}, "k: a mapping with keys that are not text cannot stand"),
        (endless(), f"k: nests deeper than {DEPTH} levels"),
    ],
)
def test_other_values_from_python_are_refused(value: Any, words: str) -> None:
    with pytest.raises(ScenarioError) as error:
        plain(value, "k")
    assert str(error.value).startswith(words)


def test_merge_goes_into_mappings_and_replaces_the_rest() -> None:
    base = {"a": {"b": 1, "c": [1, 2]}, "d": 3}
    override = {"a": {"c": [9]}, "e": {"f": 4}}
    assert merge(base, override) == {"a": {"b": 1, "c": [9]}, "d": 3, "e": {"f": 4}}
    assert base == {"a": {"b": 1, "c": [1, 2]}, "d": 3}
    assert merge(base, None) is None
    assert merge(1, {"a": 1}) == {"a": 1}


def test_merge_replaces_a_block_by_one_of_another_kind() -> None:
    base = {"kind": "sampled", "period": 0.01}
    assert merge(base, {"kind": "ideal"}) == {"kind": "ideal"}
    assert merge(base, {"kind": "sampled", "phase": 0.0}) == {"kind": "sampled", "period": 0.01, "phase": 0.0}
    assert merge(base, {"period": 0.02}) == {"kind": "sampled", "period": 0.02}


@settings(deadline=None, derandomize=True, max_examples=100)
@given(st.dictionaries(st.sampled_from("abc"), DATA, max_size=3), st.dictionaries(st.sampled_from("abc"), DATA))
def test_merging_twice_is_merging_once(base: dict[str, Any], override: dict[str, Any]) -> None:
    once = merge(base, override)
    assert merge(once, override) == once
    assert merge(base, {}) == base
    assert once.keys() == base.keys() | override.keys()


def test_put_reaches_into_mappings_and_lists_and_leaves_the_original() -> None:
    document = {"a": {"b": [1, [2, 3]]}, "c": 1}
    assert put(document, "a.b.1.0", 9) == {"a": {"b": [1, [9, 3]]}, "c": 1}
    assert put(document, "x.y", 1) == {**document, "x": {"y": 1}}
    assert put(document, "c", [1]) == {**document, "c": [1]}
    assert put({"a": None}, "a.b", 1) == {"a": {"b": 1}}
    assert put({"a": {"b": 1}}, "a", {"c": 2}) == {"a": {"b": 1, "c": 2}}
    assert document == {"a": {"b": [1, [2, 3]]}, "c": 1}


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("c.d", "c.d: 'd' cannot be set inside the value 1"),
        ("a.b.2", "a.b.2: '2' must be a position from 0 to 1"),
        ("a.b.-1", "position from 0 to 1"),
        ("a.b.01", "position from 0 to 1"),
        ("a.b.²", "position from 0 to 1"),
        ("a.b." + 5000 * "9", "position from 0 to 1"),
        ("a.b.x", "position from 0 to 1"),
        ("e.0", "the list is empty"),
        (".".join(5000 * "a"), "has more than 50 levels"),
    ],
)
def test_put_refuses_paths_that_lead_nowhere(path: str, words: str) -> None:
    with pytest.raises(ScenarioError) as error:
        put({"a": {"b": [1, 2]}, "c": 1, "e": []}, path, 0)
    assert words in str(error.value)


def test_values_are_shown_as_yaml_has_them_and_not_at_length() -> None:
    assert [short(v) for v in (None, True, 1.5, "a\nb", [None, "x"])] == [
        "null",
        "true",
        "1.5",
        "'a\\nb'",
        '[null, "x"]',
    ]
    assert len(short(list(range(1000)))) == 60
    assert dotted(("a", 0, "b")) == "a.0.b"
    assert one_line("a\nb\x00ü") == "a\\nb\\x00ü"
