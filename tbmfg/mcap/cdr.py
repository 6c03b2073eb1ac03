"""CDR, one value at a time: for messages whose layout varies from one to the next."""

from __future__ import annotations

import struct

from tbmfg.mcap.layouts import BYTE_ORDER, ENCAPSULATION
from tbmfg.timeseries import NS

_SIZES = {"B": 1, "I": 4, "i": 4, "d": 8}


class CdrReader:
    """Reads values in order from one message. Raises ValueError where the message ends too early."""

    def __init__(self, payload: bytes | memoryview) -> None:
        order = BYTE_ORDER.get(bytes(payload[:2]))
        if order is None:
            raise ValueError(f"encapsulation {bytes(payload[:2]).hex()} is not plain CDR")
        self.payload = memoryview(payload)
        self.order = order
        self.at = ENCAPSULATION

    def scalar(self, code: str) -> int | float:
        """The next value of a ``struct`` code."""
        size = _SIZES[code]
        start = self._skip((ENCAPSULATION - self.at) % size + size) - size
        return struct.unpack_from(self.order + code, self.payload, start)[0]

    def octets(self, count: int) -> memoryview:
        """The next ``count`` bytes, not copied."""
        stop = self._skip(count)
        return self.payload[stop - count : stop]

    def string(self) -> str:
        return bytes(self.octets(self.scalar("I"))).rstrip(b"\0").decode(errors="replace")

    def header(self) -> tuple[int, str]:
        """(stamp in ns, frame_id)"""
        sec, nanosec = self.scalar("i"), self.scalar("I")
        return sec * NS + nanosec, self.string()

    def _skip(self, count: int) -> int:
        if self.at + count > len(self.payload):
            raise ValueError(f"message of {len(self.payload)} bytes ends before byte {self.at + count}")
        self.at += count
        return self.at


class CdrWriter:
    """Writes values in order into one little-endian message."""

    def __init__(self) -> None:
        self._out = bytearray(b"\x00\x01\x00\x00")

    def scalars(self, code: str, *values: float) -> CdrWriter:
        """Values of one ``struct`` code."""
        size = _SIZES[code]
        self._out += bytes((ENCAPSULATION - len(self._out)) % size)
        self._out += struct.pack(f"<{len(values)}{code}", *values)
        return self

    def octets(self, data: bytes) -> CdrWriter:
        self._out += data
        return self

    def string(self, text: str) -> CdrWriter:
        data = text.encode() + b"\0"
        return self.scalars("I", len(data)).octets(data)

    def header(self, t_ns: int, frame_id: str) -> CdrWriter:
        sec, nanosec = divmod(int(t_ns), NS)
        return self.scalars("i", sec).scalars("I", nanosec).string(frame_id)

    def message(self) -> bytes:
        return bytes(self._out)
