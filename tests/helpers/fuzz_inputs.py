# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Odd numbers, texts and trees, and valid inputs with something wrong in them."""

from __future__ import annotations

import copy
import json
import struct
from collections.abc import Sequence
from typing import Any

from hypothesis import strategies as st

__all__ = [
    "YAML_PIECES",
    "alias_bombs",
    "changed",
    "damaged",
    "edited_text",
    "edited_tree",
    "mostly",
    "odd_leaves",
    "odd_texts",
]

_ODD_INTEGERS = [
    *(0, 1, -1, 2, 7, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**53 + 1),
    *(-(2**31), 2**63 - 1, 2**63, -(2**63), 2**64, 10**30, 10**308, 10**400, -(10**400)),
]
_ODD_FLOATS = [
    *(0.0, -0.0, 0.5, 1.0, -1.0, 512.0, 1e-6, 1e-300, 5e-324, 1e16, 1e200, 1.7e308, -1.7e308),
    *(float("nan"), float("inf"), float("-inf")),
]
_ODD_TEXTS = [
    *("", " ", "\n", "a\nb", "\x00", "\x1b[2J", "\u2028", "\u00b5m", "\U0001f52c", "%s%n", "{}"),
    *("nan", "inf", "-inf", "1e999", "0x10", "1_000", "1:30", "true", "null", "~", "2024-01-01"),
    *("9" * 5000, "a" * 3000, " " * 3000, "../../etc/passwd", "a.b[0]", "a.b[99999999999]"),
    "\u0665",  # a digit, but none of ASCII
    "\ud800",  # half of a surrogate pair: no UTF-8 text has it
]

odd_texts = st.sampled_from(_ODD_TEXTS) | st.text(max_size=12)
odd_leaves: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from(_ODD_INTEGERS),
    st.sampled_from(_ODD_FLOATS),
    st.floats(),
    st.integers(),
    odd_texts,
    st.none(),
    st.booleans(),
    # Copies, since the trees that they become part of are changed further.
    st.sampled_from([[], {}, [[]], [None], {"": 0}, {"a": {"b": [1]}}, [1, [2]], [0.0] * 3]).map(
        copy.deepcopy
    ),
)


def changed(text: str, old: str, new: str) -> str:
    """``text`` with another part, which must be there."""
    assert old in text, old
    return text.replace(old, new)


def mostly(usual: st.SearchStrategy[Any], *odd: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """The usual values in three of four cases, however many kinds of odd ones there are."""
    others = st.one_of(*odd)
    return st.integers(0, 3).flatmap(lambda number: others if number == 0 else usual)


YAML_PIECES = [
    *("&a ", "*a", "*a ", "<<: *a\n", "<<: [*a, *a]\n", "&a [x, x]\n", "&a {x: 1}\n", "? ", ": "),
    *("!!python/object:os.system ", "!!python/tuple ", "!!timestamp ", "!!binary ", "!!set "),
    *("!!int ", '!!int "" ', "!!float ", '!!float "" ', "!!bool ", "!!omap ", "!!pairs ", "!!str "),
    *("!!null ", "!!map ", "!!seq ", "!x ", "!<tag:x> ", "%YAML 9.9\n", "%TAG ! x:\n"),
    *(
        "---\n",
        "...\n",
        "- ",
        "  ",
        "\t",
        "\n",
        "[",
        "]",
        "{",
        "}",
        ", ",
        '"',
        "'",
        "|\n",
        ">\n",
        "#",
    ),
    *("[" * 60, "- " * 60, "{a: " * 60, "? " * 60, "[" * 9_000, "- " * 9_000, "{a: " * 9_000),
    *(
        "1e999",
        ".nan",
        ".inf",
        "-.inf",
        "0x" + "f" * 5000,
        "9" * 5000,
        "1" + ":59" * 400,
        "0b",
        "0o8",
    ),
    *("2024-99-99", "2024-01-01", "NaN", "~", "null", "yes", "=", "<<", "\ufeff", "\x85", "\u2028"),
    *("\\ud800", '"\\ud800"', '"\\x00"', '"\\UFFFFFFFF"', "\x00", "\x07", "\x7f", "\U0010ffff"),
]


@st.composite
def edited_text(draw: st.DrawFn, templates: Sequence[str], pieces: Sequence[str]) -> str:
    """A valid text with one to four pieces put in, cut out, copied, moved or repeated."""
    text = draw(st.sampled_from(templates))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(text)))
        how = draw(st.sampled_from(["insert", "insert", "replace", "delete", "line", "cut", "any"]))
        if how == "insert":
            text = text[:at] + draw(st.sampled_from(pieces)) + text[at:]
        elif how == "replace":
            length = draw(st.integers(1, 12))
            text = text[:at] + draw(st.sampled_from(pieces)) + text[at + length :]
        elif how == "delete":
            text = text[:at] + text[at + draw(st.integers(1, 40)) :]
        elif how == "line":
            lines = text.splitlines(keepends=True) or [""]
            taken = lines[draw(st.integers(0, len(lines) - 1))]
            lines.insert(draw(st.integers(0, len(lines))), taken)
            text = "".join(lines)
        elif how == "cut":
            text = text[:at]
        else:
            text = text[:at] + draw(st.text(max_size=6)) + text[at:]
    return text


def _places(tree: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """(container, key) of everything in a tree, containers of containers before their contents."""
    if isinstance(tree, dict):
        keys: Sequence[Any] = list(tree)
    elif isinstance(tree, list):
        # All elements of a long list are alike.
        keys = [*range(min(len(tree), 3)), len(tree) - 1] if tree else []
    else:
        return found
    for key in keys:
        found.append((tree, key))
        _places(tree[key], found)
    return found


@st.composite
def edited_tree(draw: st.DrawFn, templates: Sequence[str]) -> Any:
    """A valid tree of dicts and lists, given as JSON, with one to three values changed, removed, added or exchanged."""
    tree = json.loads(draw(st.sampled_from(templates)))
    for _ in range(draw(st.integers(1, 3))):
        places = _places(tree, [])
        if not places:
            break
        holder, key = places[draw(st.integers(0, len(places) - 1))]
        how = draw(st.sampled_from(["set", "set", "set", "scale", "delete", "add", "swap"]))
        if how == "set":
            holder[key] = draw(odd_leaves)
        elif how == "scale" and isinstance(holder[key], float):
            holder[key] *= draw(st.sampled_from([-1.0, 1e-30, 1e30, 1e300, 1.0 + 1e-9, 0.5, 2.0]))
        elif how == "delete":
            del holder[key]
        elif how == "add" and isinstance(holder, list):
            holder.insert(key, draw(odd_leaves))
        elif how == "add":
            holder[draw(odd_texts | st.sampled_from([1, None, 2.5]))] = draw(odd_leaves)
        else:
            other, other_key = places[draw(st.integers(0, len(places) - 1))]
            # Copied by value, so that no tree contains itself.
            holder[key] = other[other_key] if not isinstance(other[other_key], (dict, list)) else []
    return tree


@st.composite
def alias_bombs(draw: st.DrawFn, template: str) -> str:
    """YAML whose short text stands for an enormous tree, ending in a value of ``template`` (``{}`` in it)."""
    fan_out, depth = draw(st.integers(2, 10)), draw(st.integers(2, 30))
    open_, close, first = draw(
        st.sampled_from([("[", "]", "x"), ("{<<: [", "]}", "k: 1"), ("{a: [", "]}", "x")])
    )
    lines = ["bomb0: &b0 " + ("{k: 1}" if first == "k: 1" else f"[{first}]")]
    for level in range(1, depth):
        aliases = ", ".join([f"*b{level - 1}"] * fan_out)
        lines.append(f"bomb{level}: &b{level} {open_}{aliases}{close}")
    body = template.replace(
        "{}", draw(st.sampled_from([f"*b{depth - 1}", "&c [*c]", "&c {k: *c}"]))
    )
    return "\n".join([*lines, body]) if draw(st.booleans()) else "\n".join([body, *lines])


def _flip(draw: st.DrawFn, blob: bytearray, templates: Sequence[bytes]) -> None:
    blob[draw(st.integers(0, len(blob) - 1))] ^= 1 << draw(st.integers(0, 7))


def _byte(draw: st.DrawFn, blob: bytearray, templates: Sequence[bytes]) -> None:
    blob[draw(st.integers(0, len(blob) - 1))] = draw(
        st.sampled_from([0, 1, 32, 127, 128, 254, 255])
    )


def _number(draw: st.DrawFn, blob: bytearray, templates: Sequence[bytes]) -> None:
    """An odd number where a length, a count or an offset may stand."""
    code = draw(st.sampled_from(["<H", ">H", "<I", ">I", "<Q", ">Q"]))
    size = struct.calcsize(code)
    value = draw(
        st.sampled_from([0, 1, 2, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1])
        | st.integers(0, 2 * len(blob))
    )
    at = draw(st.integers(0, max(0, len(blob) - size)))
    blob[at : at + size] = struct.pack(code, value & (2 ** (8 * size) - 1))


def _insert(draw: st.DrawFn, blob: bytearray, templates: Sequence[bytes]) -> None:
    at = draw(st.integers(0, len(blob)))
    blob[at:at] = draw(st.binary(min_size=1, max_size=16))


def _remove(draw: st.DrawFn, blob: bytearray, templates: Sequence[bytes]) -> None:
    at = draw(st.integers(0, len(blob) - 1))
    del blob[at : at + draw(st.integers(1, 64))]


def _truncate(draw: st.DrawFn, blob: bytearray, templates: Sequence[bytes]) -> None:
    del blob[draw(st.integers(0, len(blob))) :]


def _splice(draw: st.DrawFn, blob: bytearray, templates: Sequence[bytes]) -> None:
    """A part of another valid input, or of the same one, in place of a part of this one."""
    other = draw(st.sampled_from(templates))
    start = draw(st.integers(0, len(other) - 1))
    length = draw(st.integers(1, 256))
    at = draw(st.integers(0, len(blob)))
    blob[at : at + draw(st.sampled_from([0, length]))] = other[start : start + length]


_DAMAGES = [
    _flip,
    _flip,
    _byte,
    _byte,
    _number,
    _number,
    _number,
    _insert,
    _remove,
    _truncate,
    _splice,
]


@st.composite
def damaged(draw: st.DrawFn, templates: Sequence[bytes]) -> bytes:
    """A valid input with one to five kinds of damage, rarely arbitrary bytes."""
    if draw(st.integers(0, 19)) == 0:
        return draw(st.binary(max_size=200))
    blob = bytearray(draw(st.sampled_from(templates)))
    for _ in range(draw(st.integers(1, 5))):
        if blob:
            draw(st.sampled_from(_DAMAGES))(draw, blob, templates)
    return bytes(blob)
