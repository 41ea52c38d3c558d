"""Damage valid files: what disks, editors, other programs and attackers make of them.

`mutate` changes bytes and words of any content; of JSON also values, so that the result is still
JSON and reaches what reads it. All choices come from the given generator.
"""

import json
import random
import re
from collections.abc import Callable, Sequence
from typing import Any

_NUMBERS = (
    *("0", "-0.0", "-1", "1", "2", "0.5", "7", "255", "256", "65536", "16777217"),
    *("2147483647", "2147483648", "4294967296", "9007199254740993", "18446744073709551616"),
    *("1e-320", "1e38", "3.5e38", "1e308", "1e999", "-1e999", "1e5000", "1e-9999999999"),
    *("nan", "NaN", "-nan", ".nan", "inf", "Infinity", "-Infinity", ".inf", "-.inf"),
    *("0x1F", "0o17", "1_000", "1.", ".5", "1e", "--1", "+1", "1,5", "١٢", "9" * 400, "9" * 5000),
    *("-" + "9" * 5000, "1" + "0" * 10_000, "0." + "3" * 5000, "true", "null", "~", "2026-11-25"),
)
"""Odd numbers, as text."""

_TEXTS = (
    *("", " ", "\0", "a\0b", "\n", "a\nb", "\r", "\t", "\x1b[2J", "\u202e", "\u2028", "\ufeff"),
    *("\x7f", "\x85", "é", "😀", "\ud800", "\udcff", "a" * 256, "b" * 5000, "é" * 200, "/" * 300),
    *("..", "../secret", "../../secret", "/etc/passwd", "/dev/zero", "~/secret", "C:\\secret"),
    *("{}", "{0.__class__}", "%s%n", "$HOME", "`id`", "__init__", "None", "os:system", "<b>&amp;"),
    *("!!python/object/apply:os.system [id]", "&a [*a, *a]", "*a", "<<: *a", "- - - -", "? : ?"),
    *("---", "...", "%YAML 9.9", "!!int x", "!!float y", "!!binary =", "!!timestamp 9", "#", "|"),
    *('<!DOCTYPE x [<!ENTITY e "ee">]>', '<include file="../secret"/>', "<!--", "]]>", "&#0;"),
)
"""Odd texts: paths, what a terminal obeys, and words that a parser may obey."""

_ENCODINGS = ("utf-16", "utf-32", "utf-7", "latin-1", "utf-8-sig", "cp037")

_NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][\w.-]*")
_QUOTED = re.compile(rb'"[^"\n]*"')

_DEPTHS = (3, 30, 300, 3000, 20_000)
_LONGEST = 120_000
"""Most bytes of an input: all readers refuse longer ones, or read them in proportion."""


def mutate(content: bytes, rng: random.Random, others: Sequence[bytes] = ()) -> bytes:
    """Return content that was damaged in one to four places.

    Args:
      content: a valid file.
      rng: the generator of all choices.
      others: other files, of which pieces are put into this one.
    """
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        if others and rng.random() < 0.05:
            content = _splice(content, rng, rng.choice(others))
        elif rng.random() < 0.5 and (changed := _mutate_json(content, rng)) is not None:
            content = changed
        else:
            content = rng.choice(_CHANGES)(content, rng)
    return content[:_LONGEST]


def odd_value(rng: random.Random) -> Any:
    """Return a value of JSON that hardly any reader expects."""
    kind = rng.randrange(8)
    if kind == 0:
        return rng.choice((None, True, False, [], {}, [[]], [{}], {"": None}, [None] * 1000))
    if kind in (1, 2, 3):
        return _number(rng)
    if kind == 4:
        return [_number(rng) for _ in range(rng.randrange(5))]
    if kind == 5:
        return {rng.choice(_TEXTS): _number(rng) for _ in range(rng.randrange(3))}
    return rng.choice(_TEXTS)


def dump(value: Any) -> bytes:
    """Return a value as JSON, in which numbers of any length are written as they are."""
    text = json.dumps(value)
    return re.sub(r'"@@([^"]*)@@"', r"\1", text).encode("utf-8", "surrogatepass")


def _number(rng: random.Random) -> Any:
    text = rng.choice(_NUMBERS)
    # JSON's own module neither reads nor writes most of them.
    return (
        rng.choice((0, -1, 1, 0.5, 1e300, 2**31, 2**53, 2**70))
        if rng.random() < 0.5
        else (f"@@{text}@@" if text.isascii() else text)
    )


def mutate_value(value: Any, rng: random.Random) -> Any:
    """Return a value of JSON with one part of it changed, left out, repeated or nested."""
    if isinstance(value, dict | list) and value and rng.random() < 0.85:
        value = value.copy()
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key = rng.choice(keys)
        kind = rng.randrange(12)
        if kind == 0:
            del value[key]
        elif kind == 1 and isinstance(value, dict):
            value[rng.choice(_TEXTS)] = value.pop(key)
        elif kind == 1 and isinstance(value, list):
            value = value * rng.choice((2, 100))
        else:
            value[key] = mutate_value(value[key], rng)
        return value
    if rng.random() < 0.1:
        for _ in range(rng.choice((1, 5, 200))):
            value = [value] if rng.random() < 0.5 else {"a": value}
        return value
    return odd_value(rng)


def _mutate_json(content: bytes, rng: random.Random) -> bytes | None:
    """Return JSON, or one of several lines of it, with a value changed; None: it is none."""
    lines = content.split(b"\n")
    place = rng.randrange(len(lines))
    for part, whole in ((content, True), (lines[place], False)):
        if part[:1] not in (b"{", b"["):
            return None
        try:
            changed = dump(mutate_value(json.loads(part), rng))
        except (ValueError, RecursionError):
            continue
        if whole:
            return changed
        lines[place] = changed
        return b"\n".join(lines)
    return None


def _flip(content: bytes, rng: random.Random) -> bytes:
    if not content:
        return b"\0"
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _span(content: bytes, rng: random.Random) -> tuple[int, int]:
    begin = rng.randrange(len(content) + 1)
    return begin, min(len(content), begin + rng.choice((1, 2, 4, 16, 64, 1000)))


def _truncate(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _delete(content: bytes, rng: random.Random) -> bytes:
    begin, end = _span(content, rng)
    return content[:begin] + content[end:]


def _repeat(content: bytes, rng: random.Random) -> bytes:
    begin, end = _span(content, rng)
    return content[:end] + content[begin:end] * rng.choice((1, 1, 2, 50)) + content[end:]


def _overwrite(content: bytes, rng: random.Random) -> bytes:
    begin, end = _span(content, rng)
    filling = rng.choice((b"\0", b"\xff", b" ", b"\n", None))
    new = rng.randbytes(end - begin) if filling is None else filling * (end - begin)
    return content[:begin] + new + content[end:]


def _insert(content: bytes, rng: random.Random) -> bytes:
    begin, _ = _span(content, rng)
    text = rng.choice((*_TEXTS, *_NUMBERS)).encode("utf-8", "surrogatepass")
    return content[:begin] + text + content[begin:]


def _replace(content: bytes, rng: random.Random) -> bytes:
    """Put an odd number in the place of a number, or an odd text in the place of a word."""
    pattern, words = rng.choice(((_NUMBER, _NUMBERS), (_NUMBER, _NUMBERS), (_WORD, _TEXTS)))
    if rng.random() < 0.2:
        pattern, words = _QUOTED, tuple(json.dumps(text) for text in _TEXTS)
    found = list(pattern.finditer(content))
    if not found:
        return _insert(content, rng)
    match = rng.choice(found)
    word = rng.choice(words).encode("utf-8", "surrogatepass")
    return content[: match.start()] + word + content[match.end() :]


def _shuffle_lines(content: bytes, rng: random.Random) -> bytes:
    """Repeat, exchange or leave out lines: a key twice, a file whose lines lost their order."""
    lines = content.splitlines(keepends=True) or [b""]
    here, there = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(3)
    if kind == 0:
        lines.insert(there, lines[here])
    elif kind == 1:
        lines[here], lines[there] = lines[there], lines[here]
    else:
        del lines[here]
    return b"".join(lines)


def _nest(content: bytes, rng: random.Random) -> bytes:
    begin, _ = _span(content, rng)
    opening, closing = rng.choice(
        ((b"[", b"]"), (b'{"a":', b"}"), (b"- ", b""), (b"<body>", b"</body>"), (b"a: ", b""))
    )
    depth = rng.choice(_DEPTHS)
    inside = opening * depth + b"1" + closing * (depth if rng.random() < 0.7 else 0)
    return content[:begin] + inside + content[begin:]


def _recode(content: bytes, rng: random.Random) -> bytes:
    return content.decode("utf-8", "replace").encode(rng.choice(_ENCODINGS), "replace")


def _splice(content: bytes, rng: random.Random, other: bytes) -> bytes:
    begin, end = _span(content, rng)
    first, last = _span(other, rng)
    return content[:begin] + other[first:last] + content[end:]


_CHANGES: Sequence[Callable[[bytes, random.Random], bytes]] = (
    *(_flip, _truncate, _delete, _repeat, _overwrite, _insert, _replace, _replace, _replace),
    *(_shuffle_lines, _nest, _recode),
)
