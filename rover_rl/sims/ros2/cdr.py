"""CDR, the bytes that ROS 2 messages are on the wire: OMG's Common Data Representation, version 1.

Four bytes say which representation follows; then the fields in order, each aligned to its own size, counted from there;
strings with their length and a closing zero; sequences with their count.

Example:
    >>> decode(Time, encode(Time(1, 500_000_000))).seconds
    1.5
"""

from __future__ import annotations

import struct
from typing import Annotated, Any, Literal, NamedTuple, Protocol, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from rover_rl.sims.ros2.messages import Array, Message

M = TypeVar("M", bound=Message)

_HEADER = b"\x00\x01\x00\x00"
"""Plain CDR, little endian, no options."""


class MalformedError(ValueError):
    """Bytes that are no message of the type that was expected."""


def encode(message: Message) -> bytes:
    """The message's bytes, little endian."""
    writer = _Writer()
    _codec(type(message)).write(writer, message)
    return _HEADER + bytes(writer.data)


def decode(kind: type[M], data: bytes) -> M:
    """The message of type ``kind`` that ``data`` holds; bytes after its end are not looked at.

    Raises:
        MalformedError: if there is none.
    """
    if len(data) < 4 or data[0] != 0 or data[1] > 1:
        raise MalformedError(f"{kind.ros_type}: {len(data)} bytes that do not begin as plain CDR")
    reader = _Reader(data, "<" if data[1] else ">")
    try:
        return _codec(kind).read(reader)
    except (struct.error, ValueError) as error:
        raise MalformedError(f"{kind.ros_type}: {error}") from error


class _Writer:
    def __init__(self) -> None:
        self.data = bytearray()

    def align(self, size: int) -> None:
        self.data.extend(bytes(-len(self.data) % size))

    def number(self, letter: str, value: float) -> None:
        self.align(struct.calcsize(letter))
        self.data.extend(struct.pack("<" + letter, value))


class _Reader:
    def __init__(self, data: bytes, order: Literal["<", ">"]) -> None:
        self.data, self.at = data, len(_HEADER)
        self.order: Literal["<", ">"] = order

    def align(self, size: int) -> None:
        self.at += (len(_HEADER) - self.at) % size

    def number(self, letter: str) -> Any:
        self.align(struct.calcsize(letter))
        (value,) = struct.unpack_from(self.order + letter, self.data, self.at)
        self.at += struct.calcsize(letter)
        return value

    def take(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise ValueError(f"{size} bytes are announced, {max(0, len(self.data) - self.at)} are there")
        self.at += size
        return self.data[self.at - size : self.at]


class _Codec(Protocol):
    def write(self, writer: _Writer, value: Any) -> None: ...

    def read(self, reader: _Reader) -> Any: ...


class _Number(NamedTuple):
    letter: str

    def write(self, writer: _Writer, value: float) -> None:
        writer.number(self.letter, value)

    def read(self, reader: _Reader) -> Any:
        return reader.number(self.letter)


class _String:
    def write(self, writer: _Writer, value: str) -> None:
        text = value.encode() + b"\x00"
        writer.number("I", len(text))
        writer.data.extend(text)

    def read(self, reader: _Reader) -> str:
        return reader.take(reader.number("I")).removesuffix(b"\x00").decode()


class _Numbers(NamedTuple):
    array: Array

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.array.letter)

    def write(self, writer: _Writer, value: NDArray[Any]) -> None:
        numbers = np.asarray(value, self.dtype.newbyteorder("<"))
        if numbers.ndim != 1 or len(numbers) != (self.array.length or len(numbers)):
            raise ValueError(f"expected {self.array.length or 'a row of'} numbers, got shape {numbers.shape}")
        if self.array.length is None:
            writer.number("I", len(numbers))
        if len(numbers):
            writer.align(self.dtype.itemsize)
            writer.data.extend(numbers.tobytes())

    def read(self, reader: _Reader) -> NDArray[Any]:
        count = reader.number("I") if self.array.length is None else self.array.length
        if not count:
            return np.zeros(0, self.dtype)
        reader.align(self.dtype.itemsize)
        data = reader.take(count * self.dtype.itemsize)
        return np.frombuffer(data, self.dtype.newbyteorder(reader.order)).astype(self.dtype)


class _Messages(NamedTuple):
    kind: type[Message]

    def write(self, writer: _Writer, value: list[Message]) -> None:
        writer.number("I", len(value))
        for message in value:
            _codec(self.kind).write(writer, message)

    def read(self, reader: _Reader) -> list[Message]:
        codec, count = _codec(self.kind), reader.number("I")
        if count > len(reader.data) - reader.at:  # no message of ours is empty: each takes a byte at least
            raise ValueError(f"{count} messages are announced in {len(reader.data) - reader.at} bytes")
        return [codec.read(reader) for _ in range(count)]


class _Struct(NamedTuple):
    kind: type[Message]
    members: tuple[tuple[str, _Codec], ...]

    def write(self, writer: _Writer, value: Message) -> None:
        for name, codec in self.members:
            codec.write(writer, getattr(value, name))

    def read(self, reader: _Reader) -> Any:
        return self.kind(**{name: codec.read(reader) for name, codec in self.members})


_codecs: dict[type[Message], _Struct] = {}


def _codec(kind: type[Message]) -> _Struct:
    """How a message is written and read, worked out once."""
    if kind not in _codecs:
        hints = get_type_hints(kind, include_extras=True)
        members = tuple((name, _member(hint)) for name, hint in hints.items() if name != "ros_type")
        _codecs[kind] = _Struct(kind, members)
    return _codecs[kind]


def _member(hint: Any) -> _Codec:
    """How a field with that annotation is written and read."""
    if hint is str:
        return _String()
    if get_origin(hint) is Annotated:
        (form,) = hint.__metadata__
        return _Numbers(form) if isinstance(form, Array) else _Number(form)
    if get_origin(hint) is list:
        return _Messages(*get_args(hint))
    return _codec(hint)
