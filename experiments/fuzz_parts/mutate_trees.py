"""Mutations of YAML and JSON: any node replaced, moved, lost or nested; YAML's own tricks: aliases, tags, merges, depth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from random import Random
from typing import Any

import yaml
from fuzz_parts.hostile import number, value, word

_ODD = (
    None,
    True,
    [],
    {},
    "",
    0,
    -1,
    1e308,
    float("nan"),
    float("inf"),
    10**400,
    [[]],
    [None],
    {"": None},
    {1: 2},
    {"a": {"a": {}}},
    [1, 2],
    [1, "a"],
    "x" * 5000,
    -(10**20),
    0.5,
    [1e308] * 3,
    [float("nan")] * 3,
    [0, 0, 0],
    ["a", "b"],
    {"column": "t"},
    {"x": [0, 1]},
)


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Yield container and key of everything in a tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in list(items):
        yield node, key
        yield from _places(child)


_MOST_PLACES = 20_000
"""Places of a tree that is still changed; aliases written out make millions of them of a few lines."""


def _listed(root: list) -> list[tuple[Any, Any]]:
    """Return containers and keys of everything in a tree; of one that is too large none."""
    places = list(islice(_places(root), _MOST_PLACES + 1))
    if len(places) > _MOST_PLACES:
        raise ValueError("too large to be changed")
    return places


def change(tree: Any, rng: Random) -> Any:
    """Return the tree with one or some nodes changed."""
    root = [tree]
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        places = _listed(root)
        if not places:
            return _copy(rng.choice(_ODD))
        holder, key = rng.choice(places if rng.random() < 0.9 else places[:1])
        match rng.randrange(8):
            case 0 | 1:
                holder[key] = _copy(rng.choice(_ODD))
            case 2:
                holder[key] = _scalar(rng)
            case 3:
                other, there = rng.choice(places)
                holder[key] = (
                    _copy(other[there]) if there in (other if isinstance(other, dict) else range(len(other))) else None
                )
            case 4 if len(places) > 1:
                del holder[key]
            case 5 if isinstance(holder, dict):
                holder[rng.choice((word(rng), number(rng), 3, True, None, 1.5))] = holder.get(key)
            case 6:
                holder[key] = [holder[key]] * rng.choice((1, 2, 4))
            case _:
                holder[key] = {rng.choice(("a", "name", "value", "effect")): holder[key]}
        if not root:
            root = [None]
    return root[0]


def leaves(tree: Any, rng: Random) -> Any:
    """Return the tree with some leaves replaced by others of their kind, which gets past checks of kinds."""
    root = [tree]
    places = [(holder, key) for holder, key in _listed(root) if not isinstance(holder[key], dict | list)]
    for holder, key in rng.sample(places, min(len(places), rng.choice((1, 1, 2, 4)))):
        old = holder[key]
        same = [there[k] for there, k in places if type(there[k]) is type(old)]
        if isinstance(old, bool):
            holder[key] = not old
        elif isinstance(old, int):
            holder[key] = rng.choice((-1, 0, 1, 2, 3, 7, 100, 10**6, 2**31, 2**63, old + 1, -old, rng.choice(same)))
        elif isinstance(old, float):
            size = rng.choice((-1, 1)) * 10 ** rng.uniform(-9, 9)
            holder[key] = rng.choice((0.0, -old, old * 1.1, 1e-300, 1e300, size, size * old, rng.choice(same)))
        else:
            holder[key] = word(rng) if rng.random() < 0.5 else rng.choice(same)
    return root[0]


def _changed(tree: Any, rng: Random) -> Any:
    return (change if rng.random() < 0.7 else leaves)(tree, rng)


def _copy(node: Any) -> Any:
    if isinstance(node, dict):
        return {k: _copy(v) for k, v in node.items()}
    return [_copy(v) for v in node] if isinstance(node, list) else node


def _scalar(rng: Random) -> Any:
    text = value(rng)
    try:
        return float(text) if rng.random() < 0.7 else text
    except ValueError:
        return text


_DEEPEST = 500
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def yaml_tree(data: bytes, rng: Random) -> bytes:
    """Change nodes of a YAML file."""
    if max(data.count(mark) for mark in (b"[", b"{", b"- -", b"? ?")) > _DEEPEST:
        return data  # PyYAML's parser in C goes down a call a level, and the process with it
    try:
        tree = yaml.load(data, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        text = yaml.dump(_changed(tree, rng), Dumper=_DUMPER, sort_keys=False, allow_unicode=True)
        return text.encode("utf-8", "replace")
    except Exception:  # the base is no YAML any more
        return data


_TRICKS = (
    b"a: &a [x, x, x, x, x, x, x, x, x]\nb: &b [*a, *a, *a, *a, *a, *a, *a, *a, *a]\n"
    b"c: &c [*b, *b, *b, *b, *b, *b, *b, *b, *b]\n"
    b"d: &d [*c, *c, *c, *c, *c, *c, *c, *c, *c]\ne: &e [*d, *d, *d, *d, *d, *d, *d, *d, *d]\n"
    b"f: &f [*e, *e, *e, *e, *e, *e, *e]\n",
    b"a: &a [*a]\n",
    b"? [a]\n: b\n",
    b"<<: 3\n",
    b"a: &a {k: 1}\nb: {<<: [*a, *a], <<: *a}\n",
    b"x: !!python/object/apply:os.system [id]\n",
    b"x: !!int ''\n",
    b"x: !!float ''\n",
    b"x: !!int '_'\n",
    b"x: !!bool maybe\n",
    b"x: !!timestamp soon\n",
    b"x: !!binary '*'\n",
    b"x: !!set {a, b}\n",
    b"x: !!omap [a: 1]\n",
    b"x: !!pairs [a]\n",
    b"x: !!null 3\n",
    b"x: !radians 1\n",
    b"x: !unknown 1\n",
    b"x: 2026-13-01\n",
    b"x: 2026-01-01 25:00:00\n",
    b"x: 0001-01-01T00:00:00+99:00\n",
    b"x: 1:1:1:1:1:1:1:1:1:1:1:1.5\n",
    b"x: 0x" + b"f" * 5000 + b"\n",
    b"x: " + b"9" * 5000 + b"\n",
    b"x: " + b"1:" * 2000 + b"1.0\n",
    b"x: 0b" + b"1" * 20000 + b"\n",
    b"%YAML 9.9\n---\nx: 1\n",
    b"---\na: 1\n---\nb: 2\n",
    b"x: " + b"[" * 400 + b"]" * 400 + b"\n",
    b"x: " + b"{a: " * 300 + b"1" + b"}" * 300,
    b"x: " + b"[" * 20000,
    b"- " * 3000 + b"x\n",
    b"x: &" + b"a" * 3000 + b" 1\ny: *b\n",
    b"\t- x\n",
    b"x: |\n  a\n b\n",
    b"x: @y\n",
    b"`a`: 1\n",
)


def yaml_tricks(data: bytes, rng: Random) -> bytes:
    """Add what YAML allows and nobody expects, before, after or in place of a value."""
    trick = rng.choice(_TRICKS)
    match rng.randrange(4):
        case 0:
            return trick + data
        case 1:
            return data.rstrip() + b"\n" + trick
        case 2:
            at = data.find(b": ", rng.randrange(len(data) + 1))
            end = data.find(b"\n", at)
            inner = trick.partition(b": ")[2] or trick
            return data[: at + 2] + inner + data[end:] if at >= 0 else trick
        case _:
            return trick


YAML = (yaml_tree, yaml_tree, yaml_tree, yaml_tricks)


def json_tree(data: bytes, rng: Random) -> bytes:
    """Change nodes of a JSON file; what is not finite is written as Python does."""
    try:
        return json.dumps(_changed(json.loads(data), rng), ensure_ascii=rng.random() < 0.5).encode("utf-8", "replace")
    except (ValueError, RecursionError):
        return data


def json_tricks(data: bytes, rng: Random) -> bytes:
    """Depth, giant numbers, double keys, other documents."""
    tricks = (
        b"[" * 100_000,
        b'{"a":' * 50_000,
        b"9" * 5000,
        b"-",
        b"NaN",
        b"null",
        b'"\\ud800"',
        b'{"command": "identify", "command": 3}',
    )
    trick = rng.choice(tricks)
    return rng.choice((trick, data.replace(b": 0", b": " + trick, 1), data[: rng.randrange(len(data) + 1)] + trick))


JSON = (json_tree, json_tree, json_tree, json_tricks)


def json_lines(data: bytes, rng: Random) -> bytes:
    """Change one line of a file of JSON lines."""
    rows = data.split(b"\n")
    k = rng.randrange(len(rows))
    rows[k] = rng.choice(JSON)(rows[k], rng)
    return b"\n".join(rows)
