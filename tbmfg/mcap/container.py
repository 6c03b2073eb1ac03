"""The MCAP container: blocks of message records, checksums, and what of a damaged file can be saved."""

from __future__ import annotations

import os
import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator
from io import BytesIO
from types import TracebackType
from typing import NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Chunk, ChunkIndex, Footer, Schema

from tbmfg.errors import LogError
from tbmfg.storage import Place, place

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_FOOTER_SIZE = HEAD.size + 20
_RAW_BLOCK = 1 << 20  # records outside chunks are handed on in blocks of about this many bytes
_RECORD_ERRORS = (McapError, struct.error, ValueError, IndexError, OverflowError)
_PLAIN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_FOREIGN = {
    b"SQLite format 3": "a rosbag2 database; convert it with: ros2 bag convert (storage_id: mcap)",
    b"#ROSBAG V": "a ROS 1 bag; convert it with: mcap convert IN.bag OUT.mcap",
    b"\x28\xb5\x2f\xfd": "compressed as a whole; unpack it with: zstd -d",
}


class Block(NamedTuple):
    """Records in a row: the content of the chunk at byte ``chunk``, or (-1) those at byte ``start`` outside.

    ``whole`` is False where the end of the file cut it short.
    """

    data: bytes
    chunk: int
    start: int
    whole: bool = True


class McapFile:
    """One MCAP file, read from front to back.

    ``schemas`` and ``channels`` by id are known from the summary where there is one, so that a lost chunk
    does not take its declarations along. ``damage`` grows while ``blocks`` is consumed.
    Raises LogError where this is not an MCAP file or cannot be opened.
    """

    def __init__(self, path: str | os.PathLike | Place) -> None:
        path = place(path)
        self.path = str(path)
        self.name = path.name
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.attachments: dict[str, bytes] = {}
        self.damage: list[str] = []
        self.position = 0
        self.index: dict[int, ChunkIndex] = {}  # by the chunk's first byte
        self._listed: list[AttachmentIndex] = []
        try:
            self._file = path.open("rb")
            self.size = self._file.seek(0, os.SEEK_END)
            self._file.seek(0)
            start = self._file.read(16)
        except OSError as error:
            raise LogError(
                f"{path}: cannot be read ({error.strerror or error}); check the name and its permissions"
            ) from None
        if not start.startswith(MAGIC):
            self._file.close()
            if not start:
                raise LogError(f"{path}: is empty (0 bytes): the recorder wrote nothing; record again")
            kind = next((text for magic, text in _FOREIGN.items() if start.startswith(magic)), None)
            detail = kind or f"{self.size} bytes, beginning with {start[:8]!r}; record with: ros2 bag record -s mcap"
            raise LogError(f"{path}: not an MCAP file ({detail})")
        self._read_summary()
        self._chunks = sorted(self.index)

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()

    def listed_attachments(self) -> dict[str, bytes]:
        """The attachments that the summary lists, read without what lies between them."""
        for one in self._listed:
            opcode, length = self._head(one.offset)
            if opcode == Opcode.ATTACHMENT and one.offset + HEAD.size + length <= self.size:
                self._attachment(one.offset, length)
        return self.attachments

    def blocks(self, wanted: Callable[[ChunkIndex], bool] | None = None) -> Iterator[Block]:
        """All readable records of the data section in file order; ``position`` tells how far it came.

        Chunks in the index that are not ``wanted`` are passed over unread.
        """
        at, raw, raw_start = len(MAGIC), bytearray(), 0
        checksummed = True  # nothing so far but records that carry a checksum of their own
        while True:
            opcode, length = self._head(at)
            stop = at + HEAD.size + length
            limit = self._limit(at)
            broken = opcode == 0 or stop > limit
            plain = opcode in _PLAIN and not broken
            if raw and (not plain or len(raw) > _RAW_BLOCK):
                yield Block(bytes(raw), -1, raw_start)
                raw.clear()
            if broken:
                if opcode == Opcode.CHUNK and limit == self.size:
                    yield from self._cut_chunk(at)
                    return
                self._note_break(at, limit)
                if limit == self.size:
                    return
                at = limit
                continue
            if plain:
                raw_start = raw_start if raw else at
                raw += self._read(at, HEAD.size + length)
                checksummed = checksummed and opcode != Opcode.MESSAGE
            elif opcode == Opcode.CHUNK:
                if wanted is None or at not in self.index or wanted(self.index[at]):
                    yield from self._chunk(at, length)
            elif opcode == Opcode.ATTACHMENT:
                self._attachment(at, length)
            elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                if opcode == Opcode.DATA_END and not checksummed:
                    self._check_data_section(at, length)
                return
            at = self.position = stop

    def load_chunk(self, at: int) -> bytes:
        """The records in the chunk at byte ``at``; raises LogError if it is not intact."""
        opcode, length = self._head(at)
        if opcode == Opcode.CHUNK and at + HEAD.size + length <= self.size:
            data, fault = _unpack(self._read(at + HEAD.size, length))
            if not fault:
                return data
        raise LogError(f"{self.path}: the chunk at byte {at} is not intact; the file changed while it was read")

    def load(self, start: int, stop: int) -> bytes:
        """Bytes ``start`` to ``stop`` of the file."""
        return self._read(start, stop - start)

    def declare(self, opcode: int, body: bytes) -> None:
        """Take up a schema or channel record."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(body))
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(body))
                self.channels[channel.id] = channel
        except _RECORD_ERRORS as error:
            self.damage.append(f"{self.name}: a declaration of {len(body)} bytes cannot be read ({error})")

    def _read(self, at: int, count: int) -> bytes:
        self._file.seek(at)
        return self._file.read(count)

    def _head(self, at: int) -> tuple[int, int]:
        head = self._read(at, HEAD.size)
        return HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)

    def _limit(self, at: int) -> int:
        """No record that begins at ``at`` reaches beyond this: the next chunk the index knows, or the end."""
        following = bisect_right(self._chunks, at)
        return self._chunks[following] if following < len(self._chunks) else self.size

    def _note_break(self, at: int, limit: int) -> None:
        """Note that no record begins at ``at``; reading goes on at ``limit``."""
        if limit < self.size:
            self.damage.append(
                f"{self.name}: {limit - at} bytes from byte {at} are no records; skipped to the next chunk"
            )
        elif at == self.size:
            self.damage.append(f"{self.name}: ends at byte {at} without a footer: the recording was cut or not closed")
        else:
            self.damage.append(
                f"{self.name}: {self.size - at} bytes from byte {at} to the end are no complete record: "
                "the file was cut or overwritten there"
            )

    def _read_summary(self) -> None:
        """Take up the summary section: declarations, the index of the chunks, where attachments lie."""
        footer_at = self.size - len(MAGIC) - _FOOTER_SIZE
        tail = self._read(max(footer_at, 0), _FOOTER_SIZE + len(MAGIC))
        if footer_at < 0 or tail[0] != Opcode.FOOTER or not tail.endswith(MAGIC):
            return
        footer = Footer.read(_stream(tail[HEAD.size :]))
        if not len(MAGIC) <= footer.summary_start < footer_at:
            return
        summary = self._read(footer.summary_start, footer_at - footer.summary_start)
        crc = zlib.crc32(summary + tail[: HEAD.size + 16])  # up to the checksum itself
        if footer.summary_crc not in (0, crc):
            self.damage.append(f"{self.name}: the summary at byte {footer.summary_start} is damaged and was not used")
            return
        at = 0
        while at + HEAD.size <= len(summary):
            opcode, length = HEAD.unpack_from(summary, at)
            at += HEAD.size + length
            body = summary[at - length : at]
            try:
                if opcode == Opcode.CHUNK_INDEX:
                    chunk = ChunkIndex.read(_stream(body))
                    self.index[chunk.chunk_start_offset] = chunk
                elif opcode == Opcode.ATTACHMENT_INDEX:
                    self._listed.append(AttachmentIndex.read(_stream(body)))
                else:
                    self.declare(opcode, body)
            except _RECORD_ERRORS as error:
                self.damage.append(f"{self.name}: an index in the summary cannot be read ({error})")

    def _chunk(self, at: int, length: int) -> Iterator[Block]:
        data, fault = _unpack(self._read(at + HEAD.size, length))
        if fault:
            lost = self._indexed(at + HEAD.size + length)
            messages = f", {lost} messages" if lost else ""
            self.damage.append(f"{self.name}: chunk at byte {at} ({length} bytes{messages}) skipped: {fault}")
        else:
            yield Block(data, at, 0)

    def _cut_chunk(self, at: int) -> Iterator[Block]:
        """What the beginning of a chunk that the end of the file cuts short still holds, without checksum."""
        data, _ = _unpack(self._read(at + HEAD.size, self.size - at))
        self.damage.append(
            f"{self.name}: the file was cut at byte {self.size} inside the chunk at byte {at}; "
            f"of its content {len(data)} bytes were read, unchecked"
        )
        if data:
            yield Block(data, at, 0, whole=False)

    def _check_data_section(self, end: int, length: int) -> None:
        """Messages outside chunks are covered by the checksum of the whole section only."""
        (expected,) = struct.unpack("<I", self._read(end + HEAD.size, 4)) if length == 4 else (0,)
        crc = 0
        for at in range(0, end if expected else 0, _RAW_BLOCK):
            crc = zlib.crc32(self._read(at, min(_RAW_BLOCK, end - at)), crc)
        if crc != expected:
            self.damage.append(f"{self.name}: checksum of the data section differs: some messages may be wrong")

    def _indexed(self, at: int) -> int:
        """Messages that the message indexes beginning at ``at`` list, those of the chunk before them."""
        count = 0
        while True:
            opcode, length = self._head(at)
            if opcode != Opcode.MESSAGE_INDEX or at + HEAD.size + length > self.size:
                return count
            count += (length - 6) // 16
            at += HEAD.size + length

    def _attachment(self, at: int, length: int) -> None:
        body = self._read(at + HEAD.size, length)
        try:
            attachment = Attachment.read(_stream(body))
            (crc,) = struct.unpack("<I", body[-4:])
        except _RECORD_ERRORS as error:
            self.damage.append(f"{self.name}: the attachment at byte {at} cannot be read ({error})")
            return
        if crc not in (0, zlib.crc32(body[:-4])):
            self.damage.append(f"{self.name}: attachment {attachment.name} ({length} bytes) skipped: checksum differs")
        else:
            self.attachments[attachment.name] = attachment.data


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _unpack(body: bytes) -> tuple[bytes, str]:
    """(records in a chunk, "") or (what could be unpacked, what is wrong with it)."""
    data = b""
    try:
        chunk = Chunk.read(_stream(body))
        if chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data)
        elif chunk.compression:
            return data, f"compression {chunk.compression!r} is unknown"
        else:
            data = chunk.data
    except (zstandard.ZstdError, RuntimeError, *_RECORD_ERRORS) as error:
        return data, f"cannot be unpacked ({error})"
    if len(data) != chunk.uncompressed_size:
        return data, f"{len(data)} of {chunk.uncompressed_size} bytes could be unpacked"
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        return data, "checksum differs"
    return data, ""
