"""Serialization of ROS 2 messages: OMG's Common Data Representation (CDR), version 1.

A header of four bytes names the representation. The fields follow in order, each aligned to its own size relative to
the end of the header. A string has its length in front and a zero byte at the end; a sequence has its number of
elements in front.

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
    """The bytes are not a message of the expected type."""


def encode(message: Message) -> bytes:
    """Serializes a message, little endian."""
    writer = _Writer()
    _codec(type(message)).write(writer, message)
    return _HEADER + bytes(writer.data)


def decode(kind: type[M], data: bytes) -> M:
    """Deserializes a message of type ``kind``. Bytes after its end are ignored.

    Raises:
        MalformedError: if ``data`` is not such a message.
    """
    if len(data) < 4 or data[0] != 0 or data[1] > 1:
        raise MalformedError(f"{kind.ros_type}: {len(data)} bytes without a header of plain CDR")
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

    def number(self, format: str, value: float) -> None:
        self.align(struct.calcsize(format))
        self.data.extend(struct.pack("<" + format, value))


class _Reader:
    def __init__(self, data: bytes, byte_order: Literal["<", ">"]) -> None:
        self.data, self.offset = data, len(_HEADER)
        self.byte_order: Literal["<", ">"] = byte_order

    def align(self, size: int) -> None:
        self.offset += (len(_HEADER) - self.offset) % size

    def number(self, format: str) -> Any:
        self.align(struct.calcsize(format))
        (value,) = struct.unpack_from(self.byte_order + format, self.data, self.offset)
        self.offset += struct.calcsize(format)
        return value

    def read_bytes(self, size: int) -> bytes:
        if size > len(self.data) - self.offset:
            raise ValueError(f"{size} bytes are announced, {max(0, len(self.data) - self.offset)} are left")
        self.offset += size
        return self.data[self.offset - size : self.offset]


class _Codec(Protocol):
    def write(self, writer: _Writer, value: Any) -> None: ...

    def read(self, reader: _Reader) -> Any: ...


class _Number(NamedTuple):
    format: str

    def write(self, writer: _Writer, value: float) -> None:
        writer.number(self.format, value)

    def read(self, reader: _Reader) -> Any:
        return reader.number(self.format)


class _String:
    def write(self, writer: _Writer, value: str) -> None:
        text = value.encode() + b"\x00"
        writer.number("I", len(text))
        writer.data.extend(text)

    def read(self, reader: _Reader) -> str:
        return reader.read_bytes(reader.number("I")).removesuffix(b"\x00").decode()


class _NumberArray(NamedTuple):
    array: Array

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.array.format)

    def write(self, writer: _Writer, value: NDArray[Any]) -> None:
        numbers = np.asarray(value, self.dtype.newbyteorder("<"))
        if numbers.ndim != 1 or len(numbers) != (self.array.length or len(numbers)):
            raise ValueError(f"expected {self.array.length or 'a list of'} numbers, got shape {numbers.shape}")
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
        data = reader.read_bytes(count * self.dtype.itemsize)
        return np.frombuffer(data, self.dtype.newbyteorder(reader.byte_order)).astype(self.dtype)


class _MessageSequence(NamedTuple):
    kind: type[Message]

    def write(self, writer: _Writer, value: list[Message]) -> None:
        writer.number("I", len(value))
        for message in value:
            _codec(self.kind).write(writer, message)

    def read(self, reader: _Reader) -> list[Message]:
        codec, count = _codec(self.kind), reader.number("I")
        if count > len(reader.data) - reader.offset:  # every message type takes at least one byte
            raise ValueError(f"{count} messages are announced in {len(reader.data) - reader.offset} bytes")
        return [codec.read(reader) for _ in range(count)]


class _Struct(NamedTuple):
    kind: type[Message]
    fields: tuple[tuple[str, _Codec], ...]

    def write(self, writer: _Writer, value: Message) -> None:
        for name, codec in self.fields:
            codec.write(writer, getattr(value, name))

    def read(self, reader: _Reader) -> Any:
        return self.kind(**{name: codec.read(reader) for name, codec in self.fields})


_codecs: dict[type[Message], _Struct] = {}


def _codec(kind: type[Message]) -> _Struct:
    """Returns the cached codec of a message type."""
    if kind not in _codecs:
        hints = get_type_hints(kind, include_extras=True)
        fields = tuple((name, _field_codec(hint)) for name, hint in hints.items() if name != "ros_type")
        _codecs[kind] = _Struct(kind, fields)
    return _codecs[kind]


def _field_codec(hint: Any) -> _Codec:
    """Returns the codec of a field from its annotation."""
    if hint is str:
        return _String()
    if get_origin(hint) is Annotated:
        (layout,) = hint.__metadata__
        return _NumberArray(layout) if isinstance(layout, Array) else _Number(layout)
    if get_origin(hint) is list:
        return _MessageSequence(*get_args(hint))
    return _codec(hint)
