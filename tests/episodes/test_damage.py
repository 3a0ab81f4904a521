"""Cut, killed, flipped: what is returned is what was written, or an error says so."""

from __future__ import annotations

import json
import os
import random
import signal
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from tests.episodes.logs import CONFIG, WORLD, policy, recorded, write
from trackmdp.episodes import container
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.episodes.recover import recover
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.errors import UserError


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("log") / "a.mcap", recorded(20))


def everything(file: Path) -> tuple[str, list[Episode]]:
    """All that a reader returns; the first as text."""
    with EpisodeReader(file) as reader:
        tables = [
            table
            for number in range(len(reader.policies))
            for table in reader.policy_tables(number)
        ]
        world = reader.world()
        said = [
            reader.said,
            reader.end,
            reader.rows,
            reader.policies,
            reader.attachment("config.yaml").decode(),
        ]
        said += [table.hex() for table in tables]
        said += [world.kernel.toarray().tobytes().hex(), world.cost.tobytes().hex()]
        return json.dumps(said), list(reader.episodes())


def regions(file: Path) -> list[tuple[int, int, int]]:
    """(opcode, first byte, end) of every record, magic and header included as opcode 0."""
    found, place = [], len(container.MAGIC)
    with file.open("rb") as stream:
        while frame := container.frame_at(stream, place):
            found.append((frame[0], place, place + len(frame)))
            place += len(frame)
    return [(0, 0, len(container.MAGIC)), *found, (0, place, file.stat().st_size)]


def test_120_flipped_bits_are_reported_or_lie_outside_all_data(log: Path, tmp_path: Path) -> None:
    """Half of them anywhere, half in metadata, attachments, header, footer and indexes, each kind as often.

    The reader passes over a flip only in records that it does not use; verifying the file reports those as well.
    """
    content, rng = log.read_bytes(), random.Random(0)
    expected, flipped = everything(log), tmp_path / "flipped.mcap"
    small = [region for region in regions(log) if region[0] != Opcode.CHUNK]
    kinds = sorted({opcode for opcode, _, _ in small})
    places = [rng.randrange(len(content)) for _ in range(60)]
    for kind in rng.choices(kinds, k=60):
        _, first, end = rng.choice([region for region in small if region[0] == kind])
        places.append(rng.randrange(first, end))
    silent = []
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.randrange(8)
        flipped.write_bytes(damaged)
        try:
            said, episodes = everything(flipped)
        except UserError as error:
            assert "\n" not in str(error)
            continue
        assert said == expected[0]
        assert all(
            first_difference(a, b) is None for a, b in zip(expected[1], episodes, strict=True)
        )
        silent += [opcode for opcode, first, end in regions(log) if first <= place < end]
        with EpisodeReader(flipped) as reader, pytest.raises(UserError, match="not a whole log"):
            reader.check_all()
    unused = {Opcode.MESSAGE_INDEX, Opcode.DATA_END, Opcode.HEADER, Opcode.CHUNK, Opcode.ATTACHMENT}
    assert set(silent) <= unused
    assert len(silent) < 60


def flushed(file: Path) -> int:
    """Episodes in the chunks that are whole, counted by the mcap package."""
    from mcap.stream_reader import StreamReader

    count, channels = 0, {}
    with file.open("rb") as stream:
        try:
            for record in StreamReader(stream, emit_chunks=False).records:
                if type(record).__name__ == "Channel":
                    channels[record.id] = record.topic
                count += (
                    type(record).__name__ == "Message" and channels[record.channel_id] == "/episode"
                )
        except Exception:  # the cut
            return count
    return count


def test_a_cut_log_gives_back_every_flushed_episode(log: Path, tmp_path: Path) -> None:
    content, rng = log.read_bytes(), random.Random(1)
    start = next(first for opcode, first, _ in regions(log) if opcode == Opcode.CHUNK)
    kept = []
    for cut in sorted(rng.randrange(start, len(content)) for _ in range(10)):
        folder = tmp_path / str(cut)
        folder.mkdir()
        part = folder / "a.mcap.part"
        part.write_bytes(content[:cut])
        saved = recover(part)
        assert saved.episodes == flushed(part)
        kept.append(saved.episodes)
        with EpisodeReader(saved.file) as reader:
            assert (len(reader), verify(reader).difference) == (saved.episodes, None)
    assert kept == sorted(kept)
    assert kept[0] < kept[-1] == 20


def test_recovering_what_lost_nothing_gives_the_same_bytes(log: Path, tmp_path: Path) -> None:
    part = tmp_path / "a.mcap.part"
    part.write_bytes(log.read_bytes()[:-20])
    saved = recover(part)
    assert saved.damaged == ()
    assert saved.file == tmp_path / "a.recovered.mcap"
    assert saved.file.read_bytes() == log.read_bytes()


def test_episodes_that_are_there_twice_are_recovered_once(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    chunks = [(first, end) for opcode, first, end in regions(log) if opcode == Opcode.CHUNK]
    (first, end), (_, last) = chunks[0], chunks[-1]
    twice = tmp_path / "a.mcap"
    twice.write_bytes(data[:end] + data[first:last] + data[first:])
    saved = recover(twice)
    assert saved.damaged
    with EpisodeReader(log) as whole, EpisodeReader(saved.file) as reader:
        assert verify(reader) == verify(whole)


def test_a_damaged_chunk_costs_only_its_own_episodes(log: Path, tmp_path: Path) -> None:
    chunks = [(first, end) for opcode, first, end in regions(log) if opcode == Opcode.CHUNK]
    assert len(chunks) > 3
    damaged = bytearray(log.read_bytes())
    damaged[sum(chunks[1]) // 2] ^= 1
    file = tmp_path / "a.mcap"
    file.write_bytes(damaged)
    with pytest.raises(UserError, match="not a whole log"):
        everything(file)
    saved = recover(file)
    with EpisodeReader(log) as whole, EpisodeReader(saved.file) as reader:
        assert saved.damaged
        kept = [row["episode"] for row in reader.rows]
        lost = sorted(set(range(20)) - set(kept))
        assert lost == list(range(lost[0], lost[-1] + 1))
        assert 0 < len(lost) < 12
        assert all(
            first_difference(whole.read(number), reader.read(number)) is None for number in kept
        )
        assert verify(reader).difference is None


def logging_child(file: Path, episodes: list[Episode], report: int) -> None:
    """Log without end; say after each flush how many episodes it holds."""
    writer = EpisodeWriter.of(file, WORLD, facts={}, config=CONFIG)
    writer.add_policy({}, policy())
    for count, episode in enumerate(episodes, start=1):
        writer.add(episode)
        if writer._unflushed == 0:
            os.write(report, struct.pack("<I", count))


def killed(work: Callable[[int], None], reports: int) -> int:
    """Run `work` in a fork, kill it after so many reports of 4 bytes; returns the last report."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        try:
            work(writing)
        finally:
            os._exit(0)
    os.close(writing)
    data = b""
    while len(data) < 4 * reports and (more := os.read(reading, 4)):
        data += more
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    os.close(reading)
    return int(struct.unpack("<I", data[-4:])[0])


@pytest.mark.parametrize("kills", [2, pytest.param(10, marks=pytest.mark.slow)])
def test_a_killed_writer_loses_nothing_that_was_flushed(kills: int, tmp_path: Path) -> None:
    episodes, rng = recorded(100 * kills), random.Random(kills)
    for kill in range(kills):
        file = tmp_path / f"{kill}.mcap"
        said = killed(
            lambda report, file=file: logging_child(file, episodes, report),
            rng.randint(1, 6 * kills),
        )
        assert not file.exists()
        saved = recover(file.with_name(f"{kill}.mcap.part"))
        assert saved.episodes >= said
        with EpisodeReader(saved.file) as reader:
            assert (len(reader), verify(reader).difference) == (saved.episodes, None)


def of_format(file: Path, change: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Path:
    from trackmdp.episodes import schema

    for name, value in change.items():
        monkeypatch.setattr(schema, name, value)
    write(file, recorded(1))
    monkeypatch.undo()
    return file


def foreign(file: Path, profile: str) -> Path:
    from mcap.writer import Writer

    writer = Writer(str(file))
    writer.start(profile=profile)
    writer.finish()
    return file


def test_bad_input_ends_in_one_clear_line(
    tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def holding(content: bytes) -> Path:
        file = tmp_path / "bad.mcap"
        file.write_bytes(content)
        return file

    cases: list[tuple[Callable[[], Path], str]] = [
        (lambda: tmp_path / "none.mcap", "no such file"),
        (lambda: tmp_path, "is a directory"),
        (lambda: holding(b""), "not an MCAP file, expected a log written with log=[mcap]"),
        (lambda: holding(b"PK\x03\x04 and more"), "not an MCAP file, expected a log"),
        (lambda: holding(log.read_bytes()[:-3]), "cut off before its end; recover=true saves"),
        (lambda: holding(log.read_bytes()[:20]), "cut off before its end; recover=true saves"),
        (
            lambda: foreign(tmp_path / "f.mcap", "ros2"),
            "not a log of trackmdp (no metadata trackmdp.run)",
        ),
        (
            lambda: of_format(tmp_path / "h.mcap", {"LOG_FORMAT": "9"}, monkeypatch),
            "format 9 (trackmdp ",
        ),
    ]
    for make, message in cases:
        file = make()
        with pytest.raises(UserError) as caught:
            EpisodeReader(file)
        assert str(caught.value).startswith(f"file={file}: {message}"), message
        assert "\n" not in str(caught.value)


def test_recover_refuses_what_it_cannot_save(tmp_path: Path, log: Path) -> None:
    headless = bytearray(log.read_bytes())
    _, first, end = next(region for region in regions(log) if region[0] == Opcode.METADATA)
    headless[(first + end) // 2] ^= 1
    file = tmp_path / "a.mcap"
    file.write_bytes(headless)
    with pytest.raises(UserError, match="too damaged"):
        recover(file)
    first = next(start for opcode, start, _ in regions(log) if opcode == Opcode.CHUNK)
    file.write_bytes(log.read_bytes()[:first])
    with pytest.raises(UserError, match="holds no whole episode; the end is missing"):
        recover(file)
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]
    file.write_bytes(log.read_bytes())
    recover(file)
    with pytest.raises(UserError, match="already exists"):
        recover(file)
