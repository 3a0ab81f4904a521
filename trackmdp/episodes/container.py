"""A log as an MCAP file: attachments and metadata by name, messages by time, each of them with a checksum.

The mcap package parses the records and compares the checksums of chunks. It compares neither the summary's checksum,
compared here at the opening, nor that over all data, compared by `check_data`.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Chunk, ChunkIndex, Metadata
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from trackmdp.errors import UserError
from trackmdp.machine import free_bytes
from trackmdp.untrusted import decoded, opened

MAGIC = b"\x89MCAP0\r\n"
_LARGEST_LOG, _LARGEST_RECORD, _LARGEST_CHUNK = 2**42, 2**30, 2**26
"""Bytes: of a record, such as an attached problem; of a chunk when unpacked, which ends after a MiB or an episode."""

_FOOTER, _DATA_END = 9 + 20, 9 + 4
"""Bytes of a record: opcode (1), length of its content (8) and content. All numbers are little-endian."""

_HEAD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
"""Before the content of a record; and before that of a message: channel, sequence, log and publish time."""

Said = tuple[str, int, bytes]
"""Topic, log time and content of a message."""


class Damaged(Exception):
    """A checksum or a structure differs from the expected one; the message names the place."""


def reading(file: Path) -> AbstractContextManager[None]:
    """Errors inside end in one line; see `untrusted.decoded`."""
    return decoded(f"file={file}", "a whole log; recover=true saves its whole episodes")


def opened_log(file: Path) -> BinaryIO:
    """The file, if it begins as an MCAP file does.

    Raises:
        UserError: it does not.
    """
    source = f"file={file}"
    stream = opened(
        file, most=_LARGEST_LOG, source=source, links=True
    )  # the user named this very file
    if stream.read(len(MAGIC)) != MAGIC:
        stream.close()
        raise UserError(f"{source}: not an MCAP file, expected a log written with log=[mcap]")
    return stream


class Container:
    """A finished MCAP file, opened for random access.

    Raises:
        UserError: not an MCAP file, an unfinished one, or one with a damaged summary.
    """

    def __init__(self, file: Path) -> None:
        with ExitStack() as opened, reading(file):
            self.stream = opened.enter_context(opened_log(file))
            self._check_summary()
            self.stream.seek(0)
            reader = SeekingReader(self.stream, record_size_limit=_LARGEST_RECORD)
            summary: Any = reader.get_summary()
            self._topics = {key: channel.topic for key, channel in summary.channels.items()}
            self._attachments = {each.name: each.offset for each in summary.attachment_indexes}
            self._metadata = {each.name: each.offset for each in summary.metadata_indexes}
            self._chunks: list[ChunkIndex] = sorted(
                summary.chunk_indexes, key=lambda chunk: chunk.message_start_time
            )
            self._ends = [chunk.message_end_time for chunk in self._chunks]
            self._held: tuple[int, list[Said]] = (-1, [])
            opened.pop_all()  # from here on it stays open

    def _check_summary(self) -> None:
        """Compare the checksum of the index of chunks, attachments and metadata."""
        # A file ends in: the summary's records, the footer record, the magic bytes. The footer holds the start of the
        # summary, the start of its offsets (unused here), and a CRC-32 of summary and footer up to itself.
        end = self.stream.seek(0, 2) - _FOOTER - len(MAGIC)
        self.stream.seek(max(end, 0))
        footer, magic = self.stream.read(_FOOTER), self.stream.read()
        if magic != MAGIC:
            raise UserError("cut off before its end; recover=true saves every whole episode")
        self._start, _, checksum = struct.unpack_from("<QQI", footer, 9)
        if not len(MAGIC) + _DATA_END <= self._start <= end <= self._start + _LARGEST_RECORD:
            raise Damaged("the footer")
        self.stream.seek(self._start)
        if zlib.crc32(self.stream.read(end - self._start) + footer[:-4]) != checksum:
            raise Damaged("the checksum of the summary")

    def check_data(self) -> None:
        """Compare the checksum of all that lies before the summary; reads the whole file.

        Raises:
            Damaged: it differs.
        """
        self.stream.seek(0)
        checksum, left = 0, self._start - _DATA_END
        while left:
            piece = self.stream.read(min(left, 2**20))
            checksum, left = zlib.crc32(piece, checksum), left - len(piece)
        # The data section ends in a record of opcode 15 with its CRC-32.
        if self.stream.read(_DATA_END) != struct.pack("<BQI", 15, 4, checksum):
            raise Damaged("the checksum of the data section")

    def attachment(self, name: str) -> bytes:
        """The content of the attachment `name`."""
        return self._named(Attachment, name, self._attachments).data

    def metadata(self, name: str) -> dict[str, str]:
        """The metadata `name`, for which the container has no checksum."""
        return self._named(Metadata, name, self._metadata).metadata

    def _named(self, kind: type[Any], name: str, offsets: dict[str, int]) -> Any:
        if name not in offsets:
            raise Damaged(f"no {kind.__name__.lower()} {name}")
        found = record_of(frame_at(self.stream, offsets[name]))
        if not isinstance(found, kind):
            raise Damaged(f"{kind.__name__.lower()} {name}")
        return found

    def messages_around(self, begin: int, end: int) -> Iterator[Said]:
        """All messages of the chunks with some from log time `begin` to `end`; logs are in order of time."""
        for chunk in self._chunks[bisect_left(self._ends, begin) :]:
            if chunk.message_start_time > end:
                return
            # Short episodes share a chunk: read one after another, the chunk is unpacked once.
            if self._held[0] != chunk.chunk_start_offset:
                found = record_of(frame_at(self.stream, chunk.chunk_start_offset))
                if not isinstance(found, Chunk):
                    raise Damaged("a chunk")
                self._held = chunk.chunk_start_offset, messages_of(found, self._topics)
            yield from self._held[1]


def frame_at(stream: BinaryIO, offset: int) -> bytes:
    """The bytes of the record at `offset`; none where there is no record, or one that reaches beyond the file."""
    stream.seek(offset)
    head = stream.read(9)
    size = int.from_bytes(head[1:], "little")
    body = stream.read(size) if size <= _LARGEST_RECORD else b""
    # No record has the opcode 0: it begins a hole of the file.
    return head + body if len(head) == 9 and head[0] and len(body) == size else b""


def record_of(frame: bytes) -> Any:
    """The record of `mcap.records` in the bytes of one record.

    Raises:
        Exception: it is damaged.
    """
    return next(StreamReader(BytesIO(frame), skip_magic=True, emit_chunks=True).records)


def messages_of(chunk: Chunk, topics: dict[int, str]) -> list[Said]:
    """The messages of a chunk, its checksum compared.

    Args:
        chunk: its record.
        topics: of each channel; the chunk's own are added.

    Raises:
        Damaged: it is too large, or has no checksum.
    """
    size = chunk.uncompressed_size
    # Before unpacking: zstd packs zeros by 30,000 to one, and a frame that names its own size is unpacked to that.
    if size > _LARGEST_CHUNK or chunk.compression not in _SIZES:
        raise Damaged(f"a chunk of {size:,} bytes, compressed by {chunk.compression or 'nothing'}")
    if _SIZES[chunk.compression](chunk.data) not in (-1, size) or not chunk.uncompressed_crc:
        raise Damaged("a chunk without a checksum, or of another size")
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    content, end, found = stream.read(size), 0, []
    # Message by message, the mcap package would take most of the time of reading a log.
    while end < size:
        begin, (kind, length) = end, _HEAD.unpack_from(content, end)
        said, end = begin + _HEAD.size, begin + _HEAD.size + length
        if end > size:
            raise Damaged("a record of a chunk")
        if kind == Opcode.MESSAGE:
            channel, _, time, _ = _MESSAGE.unpack_from(content, said)
            found.append((topics[channel], time, content[said + _MESSAGE.size : end]))
        elif kind == Opcode.CHANNEL:
            record = record_of(content[begin:end])
            topics[record.id] = record.topic
    return found


def fitting(file: Path, messages: Iterable[Said]) -> Iterator[Said]:
    """The messages of a log, as long as those of each episode fit into memory: a megabyte packed may be gigabytes.

    Raises:
        UserError: those of an episode do not.
    """
    most = left = free_bytes() // 2
    for message in messages:
        left = most if message[0] == "/episode" else left - len(message[2])
        if left < 0:
            raise UserError(f"file={file}: an episode of more than {most:,} bytes")
        yield message


_SIZES: dict[str, Callable[[bytes], int]] = {"": len, "zstd": zstandard.frame_content_size}
"""Compression -> bytes of the packed content when unpacked; -1 where it does not name them."""
