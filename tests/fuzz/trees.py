"""Damage to names and values in well-formed files: JSON, YAML, and the content of checkpoints."""

import copy
import json
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import yaml

from tests.fuzz.text import TEXT, encoded
from tests.fuzz.values import DEEP, DEPTHS, PLAIN, REAL

Where = tuple[Any, ...]
"""The keys and indices that lead to a value."""
YAML_PIECES = (
    "!!python/object/apply:os.system ['touch proof']", "!!python/object/apply:os.mkdir [proof]",
    "!!python/object/new:os.system [touch proof]", "!!python/name:os.system ''", "!!python/module:this ''",
    "!!float ''", "!!int ''", "!!bool maybe", "!!timestamp x", "!!binary \u00e9", "!!set {a}", "!!omap [a: 1]",
    "!!map x", "&a [*a]", "*nothing", "2020-99-99", "2020-01-01", "0x" + 5000 * "f", "1" + 300 * ":1" + ".0", ".nan",
    "-.inf", "~", "0o17", "0b2", '"\\ud800"', '"\\0"', "'", "|", ">", "[", "{", "? [a]", "<<: {a: 1}", "- - -", "%TAG",
)  # fmt: skip
"""Values that YAML has, and configurations should not."""
DOUBLING = "a0: &a0 [lol]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 30))
"""Nine to the power of thirty words."""


def places(tree: Any, where: Where = ()) -> list[Where]:
    """The ways to all values of a tree, itself included."""
    if isinstance(tree, dict):
        items: Sequence[tuple[Any, Any]] = list(tree.items())
    elif isinstance(tree, (list, tuple)):
        items = list(enumerate(tree))
    else:
        items = []
    return [where, *(way for key, value in items for way in places(value, (*where, key)))]


def at(tree: Any, where: Where) -> Any:
    for key in where:
        tree = tree[key]
    return tree


def changed(tree: Any, where: Where, change: Callable[[Any], Any]) -> Any:
    """A copy of a tree with one value replaced."""
    if not where:
        return change(copy.deepcopy(tree))
    copied = dict(tree) if isinstance(tree, dict) else list(tree)
    copied[where[0]] = changed(copied[where[0]], where[1:], change)
    return tuple(copied) if isinstance(tree, tuple) else copied


def other_value(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    return changed(tree, random.choice(places(tree)), lambda _: random.choice(values))


def other_leaf(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    leaves = [where for where in places(tree) if not isinstance(at(tree, where), (dict, list, tuple))]
    return changed(tree, random.choice(leaves), lambda _: random.choice(values)) if leaves else tree


def without(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    def drop(inner: Any) -> Any:
        if isinstance(inner, dict) and inner:
            inner.pop(random.choice(list(inner)))
        elif isinstance(inner, list) and inner:
            inner.pop(random.randrange(len(inner)))
        return inner

    return changed(tree, random.choice(_inner(tree)), drop)


def with_word(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    """An entry more, often one that the format knows."""

    def add(inner: Any) -> Any:
        value = random.choice((random.choice(values), random.choice(values), 1, 0.1, "x"))
        if isinstance(inner, dict):
            inner[random.choice((*words, *words, "unheard of", ""))] = value
        elif isinstance(inner, list):
            inner.insert(random.randrange(len(inner) + 1), value)
        return inner

    return changed(tree, random.choice(_inner(tree)), add)


def in_disorder(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    def shuffle(inner: Any) -> Any:
        if isinstance(inner, list):
            random.shuffle(inner)
        return inner

    return changed(tree, random.choice(_inner(tree)), shuffle)


def twice(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    def double(inner: Any) -> Any:
        return inner * random.choice((2, 2, 20)) if isinstance(inner, list) else inner

    return changed(tree, random.choice(_inner(tree)), double)


def wrapped(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    return changed(tree, random.choice(places(tree)), lambda value: random.choice(([value], [[value]], {"a": value})))


def swapped(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    """A value also stands where another one was."""
    first, second = (random.choice(places(tree)) for _ in range(2))
    return changed(tree, first, lambda _: copy.deepcopy(at(tree, second)))


def other_magnitude(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any]) -> Any:
    """A number, or all of a list, multiplied."""
    factor = random.choice((-1, 0, 1e-3, 1e3, 1e-30, 1e30, 1e150, *REAL))

    def scale(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return type(value)(scale(part) for part in value)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return float(value) * factor if number and abs(value) < 1e300 else value

    return changed(tree, random.choice(places(tree)), scale)


def _inner(tree: Any) -> list[Where]:
    """The paths to values that contain others."""
    return [where for where in places(tree) if isinstance(at(tree, where), (dict, list))] or [()]


TREE = (
    other_value, other_leaf, other_leaf, other_leaf, without, without, with_word, with_word, in_disorder, twice,
    wrapped, swapped, other_magnitude, other_magnitude,
)  # fmt: skip


def damaged_tree(random: Random, tree: Any, words: Sequence[str], values: Sequence[Any] = PLAIN) -> tuple[Any, str]:
    """A tree with damage, and its description."""
    change = random.choice(TREE)
    return change(random, tree, words, values), change.__name__


def damaged_json(random: Random, content: bytes, words: Sequence[str]) -> tuple[bytes, str]:
    try:
        tree, what = damaged_tree(random, json.loads(content), words)
    except (ValueError, RecursionError):  # damaged before
        return random.choice(TEXT)(random, content), "text"
    depth = random.choice(DEPTHS)
    text = json.dumps(tree, ensure_ascii=random.random() < 0.9)
    return encoded(text.replace(f'"{DEEP}"', "[" * depth + "]" * depth)), what


def damaged_yaml(random: Random, content: bytes, words: Sequence[str]) -> tuple[bytes, str]:
    if random.random() < 0.3:
        return _with_piece(random, content.decode("utf-8", "replace")), "piece"
    try:
        if b"&" in content:  # values that would fill the memory must not be unpacked here either
            raise ValueError
        tree, what = damaged_tree(random, yaml.safe_load(content), words)
        text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=random.random() < 0.5)
    except Exception:  # damaged before
        return random.choice(TEXT)(random, content), "text"
    depth = random.choice((60, 200, 400, 5000))
    return encoded(text.replace(f"'{DEEP}'", "[" * depth + "]" * depth)), what


def _with_piece(random: Random, text: str) -> bytes:
    """A value is replaced by something that only YAML thinks of."""
    if random.random() < 0.1:
        return encoded(DOUBLING + text + "learning_rate: *a29\n")
    lines = text.splitlines()
    index = random.randrange(len(lines)) if lines else 0
    name = lines[index].split(":")[0] if lines else "a"
    return encoded("\n".join([*lines[:index], f"{name}: {random.choice(YAML_PIECES)}", *lines[index + 1 :]]) + "\n")
