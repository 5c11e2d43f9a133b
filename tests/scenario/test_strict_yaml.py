"""The YAML reader: values, lines, and texts that are made to hurt."""

import math

import pytest
import yaml

from derail_ros.scenario import ScenarioError, loads_scenario, parse_set
from derail_ros.scenario.strict_yaml import FAST_LOADER, MAX_BYTES, dump, parse, plain_scalar

LOADERS = {"python": yaml.SafeLoader, "fast": FAST_LOADER}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e6", 1e6),
        ("1E6", 1e6),
        ("+1.5e-3", 1.5e-3),
        ("50e3", 50e3),
        (".5", 0.5),
        ("1.", 1.0),
        ("-0", 0),
        ("010", 10),
        ("null", None),
        ("~", None),
        ("", None),
        ("true", True),
        ("False", False),
        ("yes", "yes"),
        ("off", "off"),
        ("1:30", "1:30"),
        ("0x10", "0x10"),
        ("0o17", "0o17"),
        ("1_000", "1_000"),
        ("2020-01-01", "2020-01-01"),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        (".infx", ".infx"),
        ("1e6\n", "1e6\n"),
    ],
)
def test_plain_scalar(text, value):
    assert plain_scalar(text) == value
    assert type(plain_scalar(text)) is type(value)


@pytest.mark.parametrize("loader", LOADERS.values(), ids=LOADERS)
def test_values_and_lines(loader):
    text = "a: 1\nb:\n  - x\n  - {c: '2', d: [true]}\n'e': |\n  text\n"
    document = parse(text, "f", loader)
    assert document.data == {"a": 1, "b": ["x", {"c": "2", "d": [True]}], "e": "text\n"}
    lines = {path: mark.line for path, mark in document.marks.items()}
    assert lines == {
        (): 1,
        ("a",): 1,
        ("b",): 2,
        ("b", 0): 3,
        ("b", 1): 4,
        ("b", 1, "c"): 4,
        ("b", 1, "d"): 4,
        ("b", 1, "d", 0): 4,
        ("e",): 5,
    }


def test_dump_reads_back_as_the_same():
    data = {
        "words": ["1e6", "08", "yes", "null", "", "0o17", "é 你", " x ", "a: b", "# c", "~", "1."],
        "numbers": [0.0, 1e-05, 1e22, 3, -2.5, 1e300],
        "others": [True, False, None, [], [[1, 2]]],
        "text": "several\nlines\n",
        "inner": {"list": [{"a": 1}, {}]},
    }
    assert parse(dump(data), "f").data == data


def test_alias_bomb_is_refused_at_once():
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    with pytest.raises(ScenarioError, match="anchors and aliases") as caught:
        loads_scenario("\n".join(lines))
    assert caught.value.line == 1  # where the first anchor is, before any alias


@pytest.mark.parametrize("loader", LOADERS.values(), ids=LOADERS)
@pytest.mark.parametrize("text", ["[" * 5000, "{a: " * 5000, "- " * 5000, "a:\n" * 3 + "? " * 500])
def test_deep_nesting_is_refused(text, loader):
    with pytest.raises(ScenarioError):
        parse(f"x: {text}" if text[0] in "[{" else text, "f", loader)


@pytest.mark.parametrize(
    "line",
    [
        "k{i}: 1",
        "- {i}",
        "k{i}: [1, 2, {{a: b}}]",
        "? k{i}",
        "train: {{k{i}: 3}}",
        "- {{a{i}: 'x'}}",
    ],
)
@pytest.mark.parametrize("head", ["version: 1\n", "version: 1\nextends: mississauga\n"])
def test_refusing_the_largest_texts_takes_work_in_proportion_to_their_size(line, head, calls):
    body = "\n".join(line.format(i=i) for i in range(100_000))

    def refuse(size):
        with pytest.raises(ScenarioError):
            loads_scenario(head + body[:size])

    refuse(100)  # the files that ship are read once
    size = MAX_BYTES - 100
    assert calls(lambda: refuse(size)) < 6 * calls(lambda: refuse(size // 4))


def test_refusing_many_overrides_takes_work_in_proportion_to_their_number(calls):
    def refuse(number):
        body = "\n".join(f"  ground.k{i}: 1" for i in range(number))
        with pytest.raises(ScenarioError, match="unknown key"):
            loads_scenario(f"version: 1\nextends: mississauga\ntitle: x\noverrides:\n{body}\n")

    refuse(1)
    assert calls(lambda: refuse(10_000)) < 6 * calls(lambda: refuse(2_500))


@pytest.mark.parametrize(
    ("text", "result"),
    [
        ("train.speed_kmh=72", ("train.speed_kmh", 72)),
        (" a.b = 1e6 ", ("a.b", 1e6)),
        ("a=true", ("a", True)),
        ("a=null", ("a", None)),
        ("a=", ("a", None)),
        ("a=front", ("a", "front")),
        ("a='1'", ("a", "1")),
        ("a=[1, 2.5]", ("a", [1, 2.5])),
        ("a={b: 1}", ("a", {"b": 1})),
        ("a=b=c", ("a", "b=c")),
    ],
)
def test_parse_set(text, result):
    assert parse_set(text) == result


@pytest.mark.parametrize("text", ["a", "", "=1", "a=[1", "a=*b", "a=!!int 3", "a={b: 1, b: 2}"])
def test_parse_set_refuses(text):
    with pytest.raises(ScenarioError) as caught:
        parse_set(text)
    assert caught.value.file == "--set"
