"""Base of the packet bodies that `adis_gonio.device.bus.wire.protocol` describes."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, fields
from typing import ClassVar, Self, dataclass_transform

import numpy as np

from adis_gonio.base.errors import ProtocolError


@dataclass_transform(frozen_default=True)
class Body:
    """Body of a packet: fixed fields, followed by words, by text or by nothing.

    A subclass is a frozen dataclass; its class arguments set the attributes below.

    Attributes
    ----------
    TYPE : int
        Type of the packets that carry this body.
    LAYOUT : struct.Struct
        The fixed fields, little endian.
    COUNTS : tuple of int
        Number of elements of each fixed field; a field with more than one is a tuple.
    TAIL : str
        Content after the fixed fields: `words`, `text`, or empty for nothing.
    """

    TYPE: ClassVar[int]
    LAYOUT: ClassVar[struct.Struct]
    COUNTS: ClassVar[tuple[int, ...]]
    TAIL: ClassVar[str]

    def __init_subclass__(cls, *, type: int, layout: str = "", tail: str = "") -> None:
        cls.TYPE, cls.LAYOUT, cls.TAIL = type, struct.Struct(f"<{layout}"), tail
        cls.COUNTS = tuple(int(count or 1) for count in re.findall(r"(\d*)[BHI]", layout))
        dataclass(frozen=True)(cls)

    def pack(self) -> bytes:
        """Encode the body as bytes."""
        values = [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]
        tail = b""
        if self.TAIL == "words":
            tail = np.asarray(values.pop(), "<u2").tobytes()
        elif self.TAIL == "text":
            tail = str(values.pop()).encode("ascii")
        flat: list[int] = []
        for value in values:
            flat.extend(value if isinstance(value, tuple) else (value,))
        return self.LAYOUT.pack(*flat) + tail

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Decode the body from bytes.

        Raises
        ------
        ProtocolError
            The number of bytes does not fit the fields of this class.
        """
        size = cls.LAYOUT.size
        tail = data[size:]
        if len(data) < size or (tail and not cls.TAIL) or (cls.TAIL == "words" and len(tail) % 2):
            raise ProtocolError(f"the firmware's packet {cls.__name__} has {len(data)} bytes, not {size}")
        flat = list(cls.LAYOUT.unpack_from(data))
        values: list[object] = []
        for count in cls.COUNTS:
            taken, flat = flat[:count], flat[count:]
            values.append(taken[0] if count == 1 else tuple(taken))
        if cls.TAIL == "words":
            values.append(np.frombuffer(tail, "<u2").astype(np.uint16))
        elif cls.TAIL == "text":
            values.append(tail.decode("ascii", "replace"))
        return cls(*values)
