"""Messages that are well-typed and absurd, made from the definition of any type, and bytes that are no messages."""

import re
from collections.abc import Iterator

import numpy as np
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

_NOT_UTF8 = "NOT_UTF8"
"""Replaced in the serialised message by as many bytes that are no text."""

_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e300, -1e300, float("inf"), float("-inf"), float("nan"))
_NAMES = ("observer", "controller", "lbr_A1", "lbr_link_0", "obstacles", "edges", "rest", "fixed", "arm")
_KEYS = ("contact link", "stop code")
_TEXTS = ("", "nan", "-1e999 0 0", *_NAMES, *_KEYS, "\N{SNOWMAN}\n\t%s {0}", "a" * 10_000, _NOT_UTF8)
_COUNTS, _COPIES = (0, 1, 2, 7, 3000), (0, 1, 2, 7, 100)
"""Of numbers or texts in a list, and of messages."""


@st.composite
def hostile(draw, valid):
    """A serialised message like `valid`, of whose fields one, a few, or all are absurd."""
    message = _copy(valid)
    _spoil(draw, message)
    return serialize_message(message).replace(_NOT_UTF8.encode(), b"\xff\xfe\xc0\x80\xed\xa0\x80\xff")


def _copy(message):
    return deserialize_message(serialize_message(message), type(message))


def _spoil(draw, message):
    """Put absurd values into some of the fields, at any depth."""
    fields = list(_fields(message))
    places = st.integers(0, len(fields) - 1)
    chosen = draw(places.map(lambda place: {place}) | st.sets(places, max_size=5) | st.just(set(range(len(fields)))))
    for place in sorted(chosen):
        owner, name, kind = fields[place]
        value = getattr(owner, name)
        setattr(owner, name, _absurd_list(draw, kind, value) if _is_list(kind) else _absurd(draw, kind))


def _fields(message):
    """Owner, name and type of all fields that are no messages, at any depth; of lists also the whole."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if _is_list(kind):
            yield message, name, kind
            for entry in value if "/" in kind else ():
                yield from _fields(entry)
        elif "/" in kind:
            yield from _fields(value)
        else:
            yield message, name, kind


def _is_list(kind):
    return kind.startswith("sequence") or kind.endswith("]")


def _absurd(draw, kind):
    if kind.startswith(("float", "double")):
        value = draw(st.sampled_from(_FLOATS) | st.floats())
        limit = 3e38 if kind == "float" else np.inf
        return value if not np.isfinite(value) else float(np.clip(value, -limit, limit))
    if kind in ("octet", "byte"):
        return bytes([draw(st.integers(0, 255))])
    if kind == "boolean":
        return draw(st.booleans())
    whole = re.fullmatch(r"(u?)int(\d+)", kind)
    if whole:
        bits = int(whole[2])
        low, high = (0, 2**bits - 1) if whole[1] else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return draw(st.sampled_from([low, 0, 1, high]) | st.integers(low, high))
    return draw(st.sampled_from(_TEXTS) | st.text(max_size=20).map(_sendable))


def _absurd_list(draw, kind, value):
    """Another number of values, of which the first ones are absurd."""
    element = re.sub(r"sequence<(.*?)(, \d+)?>|(.*)\[\d+\]", r"\1\3", kind)
    if "/" in element:
        spoiled = [_copy(each) for each in value[:1]]
        for one in spoiled:
            _spoil(draw, one)
        return spoiled * draw(st.sampled_from(_COPIES))
    fixed = re.search(r"\[(\d+)\]$", kind)
    count = int(fixed[1]) if fixed else draw(st.sampled_from(_COUNTS))
    few = [_absurd(draw, element) for _ in range(min(count, 3))]
    return (few * (count // 3 + 1))[:count]


def _sendable(text):
    # A text of a message ends at its first zero; surrogates cannot be encoded.
    return text.replace("\0", "").encode(errors="ignore").decode()


def garbage(message: bytes) -> Iterator[bytes]:
    """Nothing, a serialised message cut off at many places, and random bytes with and without a message's header."""
    header = message[:4]
    yield b""
    yield header + b"\xff\xff\xff\x7f"
    for end in range(1, len(message) - 8, max(1, len(message) // 40)):
        yield message[:end]
    random = np.random.default_rng(0)
    for size in range(1, 200, 7):
        yield random.bytes(size)
        yield header + random.bytes(size)
