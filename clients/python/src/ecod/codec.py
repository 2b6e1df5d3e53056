"""Reading and checking of payloads, driven by the types of their fields."""

from __future__ import annotations

import json
import math
import numbers
import uuid
from collections.abc import Mapping, Set
from dataclasses import MISSING, fields, is_dataclass
from functools import lru_cache
from typing import Annotated, Any, Callable, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

from .errors import Invalid
from .messages import MILLIMETRES, SCHEMA_VERSION, Rule

# Checks and converts a value; the second argument is whether it comes from the compact encoding.
Reader = Callable[[Any, bool], Any]

# Largest map by default: `mqtt.max_map_bytes` of nodes.
MAX_BYTES = 8 * 1024 * 1024


class Flaw(Exception):
    """A value that the protocol does not allow, and its place in the payload."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.place = ""

    def __str__(self) -> str:
        return f"{self.place.lstrip('.')}: {self.args[0]}" if self.place else str(self.args[0])


class Rejected(Exception):
    """A payload of others that is not taken. `args` are the reason's name in docs/protocol.md and the details."""


def decode(kind: Any, payload: bytes) -> Any:
    """A payload of this kind of message, in any encoding that nodes send."""
    if len(payload) > MAX_BYTES:
        raise Rejected("too_large", f"{len(payload)} bytes, at most {MAX_BYTES} are read")
    if payload[:1] == b"\xec":
        raise Rejected("signed", "this package does not read signed payloads (`mqtt.sign`)")
    try:
        tree, is_compact = _parse(payload)
        schema = tree[0] if is_compact else tree["schema"]
        if schema != SCHEMA_VERSION:
            raise Rejected("unknown_schema", f"schema {schema!r}: this package reads version {SCHEMA_VERSION}")
        return reader(kind)(tree, is_compact)
    except (Flaw, ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        raise Rejected("malformed", str(error)) from error


def _parse(payload: bytes) -> tuple[Any, bool]:
    if payload[:1] in (b"{", b" ", b"\n", b"\r", b"\t"):
        return json.loads(payload), False
    try:
        import cbor2
    except ImportError:
        raise Rejected("cbor", "the cell sends CBOR: pip install 'ecod[cbor]'") from None
    try:
        return cbor2.loads(payload), 0x80 <= payload[0] <= 0x9F
    except Exception as error:  # its errors have no base other than this
        raise ValueError(f"CBOR: {error}") from error


def encode(message: Any) -> bytes:
    """A message as JSON.

    Raises `Invalid` when a value is outside the protocol.
    """
    try:
        kind: Any = type(message)
        checked = reader(kind)(message, False)
    except (Flaw, OverflowError) as flaw:
        raise Invalid(f"not sent: {flaw}") from None
    return json.dumps(_plain(checked), allow_nan=False, separators=(",", ":")).encode()


def checked(kind: Any, value: Any, place: str) -> Any:
    """The value as this type of a field has it.

    Raises `Invalid` with the place when the value is outside the protocol.
    """
    try:
        return reader(kind)(value, False)
    except Flaw as flaw:
        raise Invalid(f"not sent: {place}{flaw.place}: {flaw.args[0]}") from None


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        named = ((field.name, getattr(value, field.name)) for field in fields(value))
        return {name: _plain(part) for name, part in named if part is not None and part != {}}
    return [_plain(part) for part in value] if isinstance(value, (list, tuple)) else value


@lru_cache(maxsize=None)
def reader(kind: Any) -> Reader:
    """The reader of a type: a message, or the type of a field."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _ruled(reader(args[0]), args[1], MILLIMETRES in args)
    if origin is Union:
        inner = reader(args[0])
        return lambda value, is_compact: None if value is None else inner(value, is_compact)
    if origin is Literal:
        return _word(args)
    if origin in (list, tuple):
        return _sequence(origin, [reader(part) for part in args])
    if origin is dict:
        return _dict(*map(reader, args))
    return _SCALARS[kind] if kind in _SCALARS else _message(kind)


def _ruled(inner: Reader, rule: Rule, in_millimetres: bool) -> Reader:
    def read(value: Any, is_compact: bool) -> Any:
        value = inner(value, is_compact)
        if in_millimetres and is_compact:
            value /= 1000
        value = rule.form(value)
        return value if rule.holds(value) else _fail(value, rule.text)

    return read


def _float(value: Any, _is_compact: bool) -> Any:
    # The test of the type itself is only faster.
    is_number = type(value) is float or isinstance(value, numbers.Real) and not isinstance(value, bool)
    try:
        if is_number and math.isfinite(value):
            return float(value)
    except OverflowError:  # a whole number of more than 1024 bits
        pass
    return _fail(value, "must be a finite number")


def _int(value: Any, _is_compact: bool) -> Any:
    is_whole = type(value) is int or isinstance(value, numbers.Integral) and not isinstance(value, bool)
    return int(value) if is_whole else _fail(value, "must be a whole number")


def _text(value: Any, _is_compact: bool) -> Any:
    if isinstance(value, bytes) and len(value) == 16:  # an id in CBOR
        return str(uuid.UUID(bytes=value))
    if isinstance(value, bytes) and len(value) == 32:  # a hash in CBOR
        return value.hex()
    return str(value) if isinstance(value, str) else _fail(value, "must be text")


def _bool(value: Any, _is_compact: bool) -> Any:
    return value if isinstance(value, bool) else _fail(value, "must be true or false")


_SCALARS: dict[Any, Reader] = {float: _float, int: _int, str: _text, bool: _bool}


def _word(words: tuple[str, ...]) -> Reader:
    def read(value: Any, is_compact: bool) -> Any:
        if is_compact and type(value) is int and 0 <= value < len(words):
            return words[value]
        return value if value in words else _fail(value, f"must be one of {', '.join(words)}")

    return read


def is_list(value: Any) -> bool:
    """Whether a value has parts in an order: a list, a tuple or an array of at least one dimension."""
    if isinstance(value, (str, bytes, Mapping, Set)) or not hasattr(value, "__getitem__"):
        return False
    try:
        return len(value) >= 0
    except TypeError:  # an array without dimensions
        return False


def number_of(value: Any, place: str) -> float:
    """A finite number in any type that has one, also of numpy and torch.

    Raises `Invalid` with the place.
    """
    try:
        if isinstance(value, (str, bytes, bool)):
            _fail(value, "must be a finite number")
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            _fail(value, "must be a finite number")
        return float(_float(number, False))
    except Flaw as flaw:
        raise Invalid(f"{place}: {flaw}") from None


def numbers_of(values: Any, names: str, place: str) -> tuple[float, ...]:
    """As many finite numbers as there are names.

    Raises `Invalid` with the place.
    """
    if not is_list(values) or len(values) != len(names.split()):
        shown = repr(values)
        raise Invalid(f"{place}: {shown if len(shown) <= 60 else shown[:60] + '…'} must be the numbers {', '.join(names.split())}")
    return tuple(number_of(value, f"{place}[{index}]") for index, value in enumerate(values))


def _sequence(kind: Any, inner: list[Reader]) -> Reader:
    """A list of any length, or a tuple of as many parts as it has readers."""

    def read(value: Any, is_compact: bool) -> Any:
        if not is_list(value):
            _fail(value, "must be a list")
        if kind is tuple and len(value) != len(inner):
            _fail(value, f"must be a list of {len(inner)}")
        readers = inner * len(value) if kind is list else inner
        return kind(_at(f"[{place}]", readers[place], part, is_compact) for place, part in enumerate(value))

    return read


def _dict(key: Reader, inner: Reader) -> Reader:
    def read(value: Any, is_compact: bool) -> Any:
        if value is None and is_compact:
            return {}
        if not isinstance(value, dict):
            _fail(value, "must be an object")
        return {key(name, False): _at(f"[{name!r}]", inner, part, is_compact) for name, part in value.items()}

    return read


def _message(kind: Any) -> Reader:
    hints = get_type_hints(kind, include_extras=True)
    readers = [(field.name, reader(hints[field.name]), _default(field)) for field in fields(kind)]

    def read(value: Any, is_compact: bool) -> Any:
        if is_compact and isinstance(value, list):
            parts = {name: part for (name, _, _), part in zip(readers, value) if part is not None}
        elif isinstance(value, (dict, kind)):
            parts = value if isinstance(value, dict) else vars(value)
        else:
            _fail(value, f"must be {kind.__name__}")
        return kind(*(_at(f".{name}", inner, parts.get(name, default), is_compact) for name, inner, default in readers))

    return read


def _default(field: Any) -> Any:
    if field.default_factory is not MISSING:
        return field.default_factory()
    return None if field.default is MISSING else field.default


def _at(place: str, inner: Reader, value: Any, is_compact: bool) -> Any:
    """Reads a part; an error names its place."""
    try:
        return inner(value, is_compact)
    except Flaw as flaw:
        flaw.place = place + flaw.place
        raise


def _fail(value: Any, text: str) -> NoReturn:
    shown = "is missing," if value is None else repr(value[:60] if isinstance(value, (str, bytes, list)) else value)
    raise Flaw(f"{shown if len(shown) <= 60 else shown[:60] + '…'} {text}")
