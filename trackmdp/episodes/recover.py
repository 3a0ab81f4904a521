"""Rebuilding a log that was cut off or damaged: every whole episode is written anew."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Chunk, DataEnd, Metadata

from trackmdp.durable import no_trace
from trackmdp.episodes import container, schema
from trackmdp.episodes.container import Damaged, Said
from trackmdp.episodes.schema import TABLES
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.errors import UserError
from trackmdp.untrusted import reason


@dataclass(frozen=True)
class Recovered:
    """The new file, the number of its episodes, and all that was damaged or missing."""

    file: Path
    episodes: int
    damaged: tuple[str, ...]


def recover(file: Path) -> Recovered:
    """Write every whole episode of `file` to a new one beside it; `file` stays as it is.

    Raises:
        UserError: not a log of this format, or its first part or every episode is lost, or the new file already exists.
    """
    # `runs/episodes.recovered.mcap` for `runs/episodes.mcap` and for `runs/episodes.mcap.part`
    target = file.with_name(f"{Path(file.name.removesuffix('.part')).stem}.recovered.mcap")
    # Not overwritten: it may be the result of an earlier recovery, and `file` may have been damaged further.
    if target.exists():
        raise UserError(f"file={file}: {target} already exists")
    with no_trace(target.with_name(f"{target.name}.part"), target):
        writer, damaged = _rewrite(file, target)
        if writer is None:
            lost = "its metadata or its problem are lost"
            raise UserError("; ".join([f"file={file}: too damaged, {lost}", *damaged]))
        try:
            if not writer.episodes:
                raise UserError("; ".join([f"file={file}: holds no whole episode", *damaged]))
            return Recovered(writer.finish(), writer.episodes, tuple(damaged))
        finally:
            writer.abandon()  # a full disk leaves it open


def taken_over(file: Path, target: Path, policies: int) -> EpisodeWriter | None:
    """A log that goes on after the first `policies` policies of another.

    None if they are not all there; `target` is then not left behind.
    """
    writer, _ = _rewrite(file, target, policies)
    if writer is not None:
        if writer.policies < policies:
            writer.abandon()
            writer.part.unlink()
            return None
        writer.flush()
    return writer


class _Parts:
    """Parts of a log that are whole, by name: metadata with their seal, and attachments; and all that was damaged."""

    writer: EpisodeWriter | None = None
    """Of the new log."""

    def __init__(self) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.damaged: list[str] = []

    def attached(self, name: str, sha256: str | None) -> bytes:
        """An attachment with the digest `sha256`."""
        content = self.attachments.get(name, b"")
        if schema.digest(content) != sha256:
            raise Damaged(f"{name} is lost")
        return content

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Note the errors of damaged parts: the next part may be whole."""
        try:
            yield
        except OSError:  # of the disk
            raise
        except Exception as error:
            self.damaged.append(reason(error))

    def messages(self, stream: BinaryIO) -> Iterator[Said]:
        """The messages of every whole chunk; attachments and metadata are kept."""
        topics: dict[int, str] = {}
        offset = len(container.MAGIC)
        while frame := container.frame_at(stream, offset):
            offset += len(frame)
            found: list[Said] = []
            with self.noting():
                record = container.record_of(frame)
                if isinstance(record, DataEnd):
                    return
                if isinstance(record, Metadata):
                    self.metadata[record.name] = schema.unseal(record.name, record.metadata)
                elif isinstance(record, Attachment):
                    self.attachments[record.name] = record.data
                elif isinstance(record, Chunk):
                    found = container.messages_of(record, topics)
            yield from found

    def begun(self, file: Path, target: Path) -> EpisodeWriter | None:
        """The new log, if all that it begins with has been found."""
        if self.writer is None and schema.RUN in self.metadata:
            said = self.metadata[schema.RUN]
            schema.check_format(file, said)
            with self.noting():
                # Without the problem, the log could not be simulated again.
                tables = {n: self.attached(n, said.get(f"{n}.sha256")) for n in TABLES}
                self.writer = EpisodeWriter(target, said, tables)
        return self.writer

    def add_policies(self, writer: EpisodeWriter, count: int) -> None:
        """Copy policies until there are `count`."""
        # One after another: the number of a policy is its place.
        for each in range(writer.policies, count):
            facts = self.metadata[f"{schema.POLICY}.{each}"]
            tables = [self.attached(*it) for it in schema.policy_tables(each, facts).items()]
            writer.flush()  # as when it was recorded, so that a copy has the same bytes
            writer.copy_policy(facts, tables)


def _rewrite(
    file: Path, target: Path, most: float = math.inf
) -> tuple[EpisodeWriter | None, list[str]]:
    """Copy the whole parts of the first `most` policies and their episodes; None without metadata and problem."""
    parts = _Parts()
    try:
        _copy(parts, file, target, most)
    except BaseException:
        if parts.writer is not None:
            parts.writer.abandon()
        raise
    return parts.writer, parts.damaged


def _copy(parts: _Parts, file: Path, target: Path, most: float) -> None:
    # From front to back, since a log that was cut off has no index: the messages of an episode are held until the
    # `/episode` message, which is its last one.
    held = list[Said]()
    with container.opened_log(file) as stream:
        for message in container.fitting(file, parts.messages(stream)):
            held.append(message)
            if message[0] != "/episode":
                continue
            writer = parts.begun(file, target)
            with parts.noting():
                if writer is None:
                    raise Damaged("an episode without metadata or problem")
                row = json.loads(message[2])
                # A resumed run records the episodes of later policies again.
                if row["policy"] >= most:
                    break
                parts.add_policies(writer, row["policy"] + 1)
                # Messages of another episode may be held as well, one with an end that was lost.
                writer.add(writer.form.decode(row, held))
            held.clear()
        writer = parts.begun(file, target)
    if held or schema.END not in parts.metadata:
        parts.damaged.append("the end is missing")
    if writer is not None:
        # Policies without a whole episode too: `taken_over` counts them.
        found = sum(name.startswith(f"{schema.POLICY}.") for name in parts.metadata)
        with parts.noting():
            parts.add_policies(writer, int(min(found, most)))
