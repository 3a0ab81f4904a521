"""Logs with right checksums and wrong content, and such as unfold to gigabytes: one line, in bounded memory."""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import Writer

from tests.episodes.logs import WORLD, recorded, write
from trackmdp.episodes import container, schema
from trackmdp.episodes.container import Damaged
from trackmdp.episodes.extracts import write_page
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.episodes.recover import recover
from trackmdp.errors import UserError
from trackmdp.world.problem_file import PROBLEM

RUN, END, POLICY, INDEX = schema.RUN, schema.END, f"{schema.POLICY}.0", "episodes.json"
TABLE = schema.policy_file(0)
Parts = dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("log") / "a.mcap", recorded(3))


def doctored(log: Path, file: Path, change: Callable[[Parts], Any]) -> Path:
    """The log with changed parts, every digest and checksum right: metadata `m`, attachments `a`, messages `x`."""
    read = make_reader(io.BytesIO(log.read_bytes()))
    parts: Parts = {
        "m": {
            each.name: schema.unseal(each.name, dict(each.metadata))
            for each in read.iter_metadata()
        },
        "a": {each.name: each.data for each in read.iter_attachments()},
        "x": {},
    }
    for _, channel, message in read.iter_messages(log_time_order=False):
        parts["x"].setdefault(channel.topic, []).append(
            (message.log_time, json.loads(message.data))
        )
    rows = json.loads(parts["a"][INDEX])
    parts["a"][INDEX] = rows
    change(parts)
    metadata, attached = parts["m"], parts["a"]
    attached[INDEX] = json.dumps(attached[INDEX]).encode()
    metadata[END][f"{INDEX}.sha256"] = schema.digest(attached[INDEX])
    for name in schema.TABLES:
        metadata[RUN][f"{name}.sha256"] = schema.digest(attached[name])
    metadata[POLICY]["table.sha256"] = schema.digest(attached[TABLE])
    with file.open("wb") as stream:
        _written(stream, parts)
    return file


def _written(stream: Any, parts: Parts) -> None:
    writer = Writer(stream, enable_data_crcs=True)
    writer.start(library=f"trackmdp {parts['m'][RUN]['trackmdp']}")
    channels = {
        topic: writer.register_channel(
            topic, "json", writer.register_schema(name, "jsonschema", b"{}")
        )
        for topic, (name, _) in schema.schemas_of(WORLD).items()
    }
    for name in (RUN, POLICY):
        writer.add_metadata(name, schema.seal(name, parts["m"][name]))
    for name, content in parts["a"].items():
        writer.add_attachment(0, 0, name, "x", content)
    order = {topic: place for place, topic in enumerate(schema.schemas_of(WORLD))}
    every = [
        (time, order[topic], topic, data)
        for topic, each in parts["x"].items()
        for time, data in each
    ]
    for time, _, topic, data in sorted(every, key=lambda message: message[:2]):
        writer.add_message(channels[topic], time, json.dumps(data).encode(), time)
    writer.add_metadata(END, schema.seal(END, parts["m"][END]))
    writer.finish()


def says(**facts: Any) -> Callable[[Parts], Any]:
    return lambda parts: parts["m"][RUN].update(facts)


def holds(name: str, **arrays: Any) -> Callable[[Parts], Any]:
    """Other arrays in an attached .npz."""

    def change(parts: Parts) -> None:
        with np.load(io.BytesIO(parts["a"][name])) as found:
            content = {**found, **arrays}
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=True, **content)
        parts["a"][name] = buffer.getvalue()

    return change


CASES: dict[str, Callable[[Parts], Any]] = {
    "size x": says(size="x"),
    "size 10^9": says(size="1000000000"),
    "size 5": says(size="5"),
    "no t_max": lambda parts: parts["m"][RUN].pop("t_max"),
    "policies 10^9": lambda parts: parts["m"][END].update(policies="1000000000"),
    "no problem": lambda parts: parts["a"].update({PROBLEM: b""}),
    "reward nan": holds(PROBLEM, reward=np.nan),
    "objects": holds(TABLE, indices=np.array([{}], object)),
    "index of {}": lambda parts: parts["a"].update({INDEX: [{}]}),
    "index is a number": lambda parts: parts["a"].update({INDEX: 3}),
    "step": lambda parts: parts["x"]["/step"][0][1].update(target="x"),
    "last cell": lambda parts: parts["x"]["/step"][0][1].update(last_cell=-1),
    "grid": lambda parts: parts["x"]["/grid"][0][1].update(data="!!"),
    "reward 10^39": lambda parts: parts["x"]["/step"][0][1].update(reward=1e39),
    "start": lambda parts: parts["a"][INDEX][0].update(start=16),
    "no start": lambda parts: parts["a"][INDEX][0].update(start=-1),
    "seed 2^200": lambda parts: parts["a"][INDEX][0].update(seed=str(2**200)),
    "policy 1": lambda parts: parts["a"][INDEX][0].update(policy=1),
    "policy 0.0": lambda parts: parts["a"][INDEX][0].update(policy=0.0),
    "return 10^9": lambda parts: parts["a"][INDEX][0].update({"return": 1e9}),
    "start time": lambda parts: parts["a"][INDEX][0].update(start_time="0"),
    "no clip": lambda parts: parts["m"][POLICY].update(memory="displacement"),
}


def read_all(file: Path) -> None:
    with EpisodeReader(file) as reader:
        write_page(reader, file.with_suffix(".html"))
        found = verify(reader)
        if found.difference is not None:
            raise UserError(found.difference)


def test_the_doctored_log_itself_is_whole(log: Path, tmp_path: Path) -> None:
    read_all(doctored(log, tmp_path / "a.mcap", lambda parts: None))


@pytest.mark.parametrize("case", CASES)
def test_a_log_that_makes_no_sense_is_refused_in_one_line(
    case: str, log: Path, tmp_path: Path
) -> None:
    file = doctored(log, tmp_path / "a.mcap", CASES[case])
    with pytest.raises(UserError) as refused:
        read_all(file)
    assert "\n" not in str(refused.value)
    try:
        recover(file)
    except UserError as error:
        assert "\n" not in str(error)


def test_the_whole_episodes_beside_a_damaged_one_are_recovered(log: Path, tmp_path: Path) -> None:
    saved = recover(doctored(log, tmp_path / "a.mcap", CASES["step"]))
    assert (saved.episodes, len(saved.damaged)) == (2, 1)
    read_all(saved.file)


@pytest.mark.parametrize("read", [recover, read_all])
def test_an_episode_larger_than_memory_is_refused(
    read: Callable[[Path], Any], log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.mcap"
    file.write_bytes(log.read_bytes())
    monkeypatch.setattr(container, "free_bytes", lambda: 2000)
    with pytest.raises(UserError, match=f"^file={file}: an episode of more than 1,000 bytes$"):
        read(file)
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]


def chunk(frame: bytes, size: int, compression: str = "zstd") -> Chunk:
    return Chunk(compression, frame, 1, 0, uncompressed_crc=1, uncompressed_size=size)


def zeros(size: int, said: bool) -> bytes:
    stream = io.BytesIO()
    packer = zstandard.ZstdCompressor(write_content_size=said)
    with packer.stream_writer(stream, size=size if said else -1, closefd=False) as writer:
        for _ in range(size // 2**20):
            writer.write(bytes(2**20))
    return stream.getvalue()


@pytest.mark.parametrize(
    ("size", "said", "claims"),
    [(2**28, True, 1000), (2**28, True, 2**28), (2**20, True, 2**62)],
)
def test_a_chunk_beyond_the_limit_is_not_unpacked(
    size: int, said: bool, claims: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        container, "get_chunk_data_stream", lambda *_, **__: pytest.fail("unpacked")
    )
    with pytest.raises(Damaged):
        container.messages_of(chunk(zeros(size, said), claims), {})


def test_a_frame_without_a_size_is_unpacked_to_the_size_of_its_chunk() -> None:
    with pytest.raises(zstandard.ZstdError):
        container.messages_of(chunk(zeros(2**28, said=False), 1000), {})


def test_other_compressions_and_chunks_without_a_checksum_are_refused() -> None:
    for bad in (chunk(b"", 0, "lz4"), replace(chunk(b"", 0, ""), uncompressed_crc=0)):
        with pytest.raises(Damaged):
            container.messages_of(bad, {})


def test_a_record_that_reaches_beyond_its_chunk_is_refused() -> None:
    content = struct.pack("<BQ", Opcode.MESSAGE, 100) + bytes(40)
    bad = replace(chunk(content, len(content), ""), uncompressed_crc=zlib.crc32(content))
    with pytest.raises(Damaged, match="a record of a chunk"):
        container.messages_of(bad, {0: "/step"})


def test_a_sparse_file_of_two_gigabytes_is_over_at_once(log: Path, tmp_path: Path) -> None:
    file = tmp_path / "a.mcap"
    with file.open("wb") as stream:
        stream.write(container.MAGIC)
        stream.truncate(2**31)
    with pytest.raises(UserError, match="too damaged"):
        recover(file)
    with file.open("wb") as stream:
        stream.write(log.read_bytes()[:-8])
        stream.truncate(2**31)
    assert recover(file).episodes == 3


def index(offset: int, length: int) -> bytes:
    """A file with a summary by which its metadata are at `offset`."""
    name = RUN.encode()
    body = struct.pack("<QQ", offset, length) + struct.pack("<I", len(name)) + name
    summary = struct.pack("<BQ", Opcode.METADATA_INDEX, len(body)) + body
    header = struct.pack("<BQ", Opcode.HEADER, 8) + bytes(8)
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, len(container.MAGIC) + len(header), 0)
    checksum = zlib.crc32(footer, zlib.crc32(summary))
    return (
        container.MAGIC + header + summary + footer + struct.pack("<I", checksum) + container.MAGIC
    )


@pytest.mark.parametrize("offset", [0, 20, 2**40, 2**63, 2**64 - 1])
@pytest.mark.parametrize("length", [0, 5, 2**40, 2**63, 2**64 - 1])
def test_an_index_that_leads_out_of_the_file(offset: int, length: int, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(index(offset, length))
    with pytest.raises(UserError, match="not a "):
        EpisodeReader(tmp_path / "a.mcap")


def test_a_pipe_is_no_log(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    with pytest.raises(UserError, match="a pipe or a device, expected an ordinary file"):
        EpisodeReader(tmp_path / "a.mcap")
