"""The MCAP container, read strictly: every byte that is handed on has a checksum, and it has been checked.

The mcap package checks neither attachments nor the summary, and looks for chunks through records without a checksum.
Here the summary is checked first, and whatever lies outside it is compared with what the summary says of it.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import BytesIO
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import Attachment, AttachmentIndex, Channel, Chunk, ChunkIndex, Header, Metadata, MetadataIndex

from trackmdp import untrusted
from trackmdp.errors import UserError
from trackmdp.untrusted import reason

MAGIC = b"\x89MCAP0\r\n"
# A record is its opcode (u8), the length of its content (u64) and the content; a string is its length (u32) and UTF-8.
# Every number is little-endian. A file's header record, right after the magic, for example:
#     01 | 16 00 00 00 00 00 00 00 | 00 00 00 00 | 0e 00 00 00  74 72 61 63 ...
#     HEADER, 22 bytes of content: profile "", then library, the 14 bytes of "trackmdp 0.2.0".
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
_FOOTER_LENGTH = 1 + 8 + 20
_CHUNK_LIMIT, _RECORD_LIMIT = 2**26, 2**30
"""Bytes of the largest chunk, unpacked, and of the largest record: a damaged or hostile size must not fill the memory.

A writer closes its chunk after one MiB or one episode's end; the longest record is an attached kernel.
"""

_LONGEST = 2**42


class Damaged(Exception):
    """A checksum or a structure that is not as it should be; the message says where."""


@contextmanager
def reading(file: Path) -> Iterator[None]:
    """Whatever damage makes raise inside ends in one line.

    Raises:
        UserError: something was damaged.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # whatever mcap, JSON, NumPy and base64 raise over what a hostile log says
        raise UserError(f"file={file}: damaged ({reason(error)}); recover=true saves what can be read") from error


@dataclass(frozen=True)
class Message:
    """One message."""

    topic: str
    log_time: int
    data: bytes


class Container:
    """A finished MCAP file, opened for random access.

    Raises:
        UserError: not an MCAP file, an unfinished one, or one whose summary is damaged.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        with ExitStack() as opened, reading(file):
            self.stream = opened.enter_context(opened_log(file))
            self.profile, self.made_by = self._header()
            self._summary()
            opened.pop_all()  # from here on it stays open

    def _header(self) -> tuple[str, str]:
        """Profile and library, the two strings of the header record."""
        opcode, body = next(records(self.stream, len(MAGIC)), (0, b""))
        if opcode != HEADER:
            raise Damaged("its first record is not the header")
        header = vars(_unchecked(Header, body))
        return header["profile"], header["library"]

    def _summary(self) -> None:
        """Read the index of chunks, attachments and metadata; its checksum covers the footer as well."""
        # A finished file ends in: the summary's records, the footer record, the magic bytes. The footer's content is
        # where the summary starts, where its offsets start (unused here), and a CRC-32 over summary and footer.
        self.length = self.stream.seek(0, 2)
        if self.length < 2 * len(MAGIC) + _FOOTER_LENGTH:
            raise UserError(_cut(self.file))
        self.stream.seek(self.length - _FOOTER_LENGTH - len(MAGIC))
        footer, magic = self.stream.read(_FOOTER_LENGTH), self.stream.read()
        if magic != MAGIC:
            raise UserError(_cut(self.file))
        # A record is its opcode (1 byte), the length of its content (8 bytes), and the content.
        opcode, size, self.summary_start, _, checksum = struct.unpack("<BQQQI", footer)
        summary_length = self.length - _FOOTER_LENGTH - len(MAGIC) - self.summary_start
        if (opcode, size) != (FOOTER, 20) or not len(MAGIC) < self.summary_start or summary_length <= 0:
            raise Damaged("the footer")
        if summary_length > _RECORD_LIMIT:
            raise Damaged(f"a summary of {summary_length:,} bytes")
        self.stream.seek(self.summary_start)
        summary = self.stream.read(summary_length)
        # zlib.crc32 takes the checksum so far: that of the summary goes on over the footer, opcode and length
        # included, but for the four bytes of the checksum itself.
        if zlib.crc32(footer[:-4], zlib.crc32(summary)) != checksum:
            raise Damaged("the checksum of the summary")
        self._index(summary)

    def _index(self, summary: bytes) -> None:
        self.channels: dict[int, str] = {}
        self.chunks: list[ChunkIndex] = []
        self.attachments: dict[str, tuple[int, int]] = {}
        self.metadata: dict[str, tuple[int, int]] = {}
        for opcode, data in _split(summary):
            if opcode == CHUNK_INDEX:
                self.chunks.append(_parsed(ChunkIndex, data))
            elif opcode == CHANNEL:
                channel = _parsed(Channel, data)
                self.channels[channel.id] = channel.topic
            elif opcode == ATTACHMENT_INDEX:
                attachment = _parsed(AttachmentIndex, data)
                self.attachments[attachment.name] = attachment.offset, attachment.length
            elif opcode == METADATA_INDEX:
                metadata = _parsed(MetadataIndex, data)
                self.metadata[metadata.name] = metadata.offset, metadata.length
        # Sorted for the bisection in `chunks_between`; a log's own order is the same.
        self.chunks.sort(key=lambda chunk: chunk.message_start_time)
        self._ends = [chunk.message_end_time for chunk in self.chunks]

    def _record(self, opcode: int, offset: int, length: int) -> bytes:
        """The content of the record that the summary says is there."""
        # A checksum shows that the summary is what was written, not that its writer was honest: these numbers may be
        # anything.
        if not (9 <= length <= min(_RECORD_LIMIT, self.length) and 0 <= offset <= self.length - length):
            raise Damaged(f"a record of {length:,} bytes at byte {offset:,}")
        self.stream.seek(offset)
        data = self.stream.read(length)
        if len(data) != length or struct.unpack_from("<BQ", data) != (opcode, length - 9):
            raise Damaged(f"the record at byte {offset}")
        return data[9:]

    def attachment(self, name: str) -> bytes:
        """The content of the attachment `name`, its checksum checked."""
        return self._named("attachment", name, self.attachments, ATTACHMENT, attachment_of)

    def tell(self, name: str) -> dict[str, str]:
        """The metadata called `name`; the container has no checksum for it."""
        return self._named("metadata", name, self.metadata, METADATA, metadata_of)

    def _named(
        self, kind: str, name: str, places: Mapping[str, tuple[int, int]], opcode: int, parsed: Callable[..., Any]
    ) -> Any:
        if name not in places:
            raise Damaged(f"no {kind} {name}")
        # The name once more, in the record: an index made with two offsets exchanged has a correct checksum as well.
        found, content = parsed(self._record(opcode, *places[name]))
        if found != name:
            raise Damaged(f"{kind} {name}")
        return content

    def chunks_between(self, begin: int, end: int) -> Iterator[ChunkIndex]:
        """The chunks with messages from log time `begin` to `end`, in their order; logs are in order of time."""
        # Chunks follow each other in time, so that the first one that ends at `begin` or later is found by bisection.
        later = self.chunks[bisect_left(self._ends, begin) :]
        return takewhile(lambda chunk: chunk.message_start_time <= end, later)

    def messages(self, chunk: ChunkIndex) -> list[Message]:
        """All messages of a chunk, its checksum checked."""
        found, content = unpacked(self._record(CHUNK, chunk.chunk_start_offset, chunk.chunk_length))
        # A chunk's checksum covers its content alone; its head is held against the summary, which has its own.
        same = ("message_start_time", "message_end_time", "uncompressed_size", "compression")
        differs = any(getattr(found, name) != getattr(chunk, name) for name in same)
        if differs or len(found.data) != chunk.compressed_size:
            raise Damaged(f"the chunk at byte {chunk.chunk_start_offset}")
        # A copy, since a chunk may repeat the definitions of channels, which are added to what is handed over.
        return list(messages_of(content, dict(self.channels)))

    def check_data(self) -> None:
        """Compare the checksum over all that lies before the summary; reads the whole file.

        Raises:
            Damaged: it differs.
        """
        # The record that closes the data section, 9 + 4 bytes before the summary, holds a CRC-32 of all before itself.
        end = self.summary_start - 13
        self.stream.seek(0)
        checksum, left = 0, end
        while left:
            data = self.stream.read(min(left, 2**20))
            checksum, left = zlib.crc32(data, checksum), left - len(data)
        opcode, size, written = struct.unpack("<BQI", self.stream.read(13))
        if (opcode, size) != (DATA_END, 4) or written not in (0, checksum):
            raise Damaged("the checksum over the data section")
        # Zero stands for `not computed` in the format. It is told apart, since the bytes may be whole.
        if written == 0:
            raise Damaged("no checksum over the data section")


def opened_log(file: Path) -> BinaryIO:
    """The file, if it begins as an MCAP file does.

    Raises:
        UserError: it does not.
    """
    stream = untrusted.opened(file, most=_LONGEST, source=f"file={file}", links=True)  # the user named this very file
    start = stream.read(len(MAGIC))
    if start != MAGIC:
        stream.close()
        what = "an empty file" if not start else "not an MCAP file"
        raise UserError(f"file={file}: {what}, expected a log written with log=[mcap]")
    return stream


def _cut(file: Path) -> str:
    return f"file={file}: cut off before its end; recover=true saves every episode that is whole"


def records(stream: BinaryIO, offset: int) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of the records from `offset` on, up to the closing magic.

    Raises:
        Damaged: one reaches beyond the end of the file.
    """
    length = stream.seek(0, 2)
    while offset < length:
        stream.seek(offset)
        head = stream.read(9)
        # read(9) returns the 8 bytes that are left.
        if length - offset == len(MAGIC) and head == MAGIC:
            return
        size = int.from_bytes(head[1:], "little")
        if len(head) < 9 or size > length - offset - 9:
            raise Damaged(f"the record at byte {offset} reaches beyond the end of the file")
        if head[0] == 0:  # no record has this opcode, but a sparse file holds nothing else, two thousand million times
            raise Damaged(f"no record at byte {offset}")
        if size > _RECORD_LIMIT:
            raise Damaged(f"a record of {size:,} bytes at byte {offset}")
        offset += 9 + size
        yield head[0], stream.read(size)


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place < len(data):
        opcode, size = struct.unpack_from("<BQ", data, place)
        place += 9 + size
        if place > len(data):
            raise Damaged("a record that reaches beyond its section")
        yield opcode, data[place - size : place]


def _parsed(kind: Any, data: bytes) -> Any:
    """The record of a kind of `mcap.records` from its content.

    That reads fewer bytes where a length leads out of the content: what is parsed here is covered by a checksum, or
    compared with something that is; else see `_unchecked`.
    """
    return kind.read(ReadDataStream(BytesIO(data)))


def _unchecked(kind: Any, data: bytes) -> Any:
    """A record that no checksum covers: only what is written again alike is what was written.

    A length that is a little wrong is read all the same by `_parsed`.
    """
    found, builder = _parsed(kind, data), RecordBuilder()
    found.write(builder)
    if builder.end()[9:] != data:
        raise Damaged(f"the record {kind.__name__}")
    return found


def attachment_of(data: bytes) -> tuple[str, bytes]:
    """Name and content of an attachment record, which ends in a CRC-32 of all before it."""
    if zlib.crc32(data[:-4]) != int.from_bytes(data[-4:], "little"):
        raise Damaged("the checksum of an attachment")
    found = _parsed(Attachment, data)
    return found.name, found.data


def metadata_of(data: bytes) -> tuple[str, dict[str, str]]:
    """Name and content of a metadata record."""
    found = _unchecked(Metadata, data)
    return found.name, found.metadata


def unpacked(data: bytes) -> tuple[Chunk, bytes]:
    """A chunk record, and its content.

    Raises:
        Damaged: the checksum is missing or wrong, or the compression cannot be undone.
    """
    chunk: Chunk = _parsed(Chunk, data)
    size = chunk.uncompressed_size
    # Before decompressing: zstd packs zeros by 30,000 to one.
    if size > _CHUNK_LIMIT:
        raise Damaged(f"a chunk of {size} bytes")
    try:
        content = _UNPACK[chunk.compression](chunk.data, size)
    except (KeyError, zstandard.ZstdError, MemoryError) as error:
        raise Damaged(f"a chunk that cannot be decompressed ({chunk.compression or 'none'})") from error
    # A checksum of 0 means that none was written; our logs always have one.
    if len(content) != size or zlib.crc32(content) != chunk.uncompressed_crc or chunk.uncompressed_crc == 0:
        raise Damaged("the checksum of a chunk")
    return chunk, content


def _unzstd(packed: bytes, size: int) -> bytes:
    """The content of a frame of `size` bytes.

    A frame that names its own size is unpacked to that, whatever `max_output_size` says: 200 kB may name 2 GiB.
    """
    if zstandard.frame_content_size(packed) not in (-1, size):
        raise Damaged("a chunk whose frame has another size")
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {"": lambda packed, _: packed, "zstd": _unzstd}


def messages_of(content: bytes, channels: dict[int, str]) -> Iterator[Message]:
    """The messages of a chunk's content; channels it defines are added to `channels`."""
    for opcode, data in _split(content):
        if opcode == MESSAGE:
            # MESSAGE: channel u16, sequence u32, log time u64, publish time u64, 22 bytes in all, then the data.
            # Channels are defined before their first message, in the same chunk or an earlier one.
            number, _, log_time, _ = struct.unpack_from("<HIQQ", data)
            if number not in channels:
                raise Damaged(f"a message of an unknown channel {number}")
            yield Message(channels[number], log_time, data[22:])
        elif opcode == CHANNEL:
            channel = _parsed(Channel, data)
            channels[channel.id] = channel.topic
