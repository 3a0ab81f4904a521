"""Rebuilding a log that was cut off or damaged: every episode that is whole is written anew."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trackmdp.episodes import container, schema
from trackmdp.episodes.container import Damaged
from trackmdp.episodes.messages import decode
from trackmdp.episodes.schema import LoggedRun
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.errors import UserError
from trackmdp.untrusted import reason

_MOST_HELD = 2**28
"""Bytes of one episode's messages."""


@dataclass(frozen=True)
class Recovered:
    """What was saved: the new file, the episodes in it, and whether anything was damaged or missing."""

    file: Path
    episodes: int
    damaged: tuple[str, ...]


class _Found:
    """What could be read so far.

    Attributes:
        metadata: those whose seal is whole.
        attachments: their contents by their names.
        held: topic -> log time -> message, of the episode that is not complete yet.
    """

    def __init__(self) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.held: dict[str, dict[int, bytes]] = {"/step": {}, "/grid": {}}
        self._bytes = 0

    def hold(self, topic: str, time: int, data: bytes) -> None:
        """Keep a message of the episode, as long as they are not more than any episode's."""
        if topic not in self.held:
            return
        self._bytes += len(data)
        # A file without a single `/episode` message would otherwise be held whole.
        if self._bytes > _MOST_HELD:
            self.release()
        self.held[topic][time] = data

    def release(self) -> None:
        """Forget the messages."""
        self._bytes = 0
        for messages in self.held.values():
            messages.clear()

    def between(self, topic: str, begin: int, end: int) -> list[bytes]:
        """The messages from one log time to another: some of an episode whose own end was lost may stand before."""
        return [data for time, data in self.held[topic].items() if begin <= time <= end]


def recover(file: Path) -> Recovered:
    """Write every whole episode of `file` to a new one beside it; `file` stays as it is.

    Raises:
        UserError: not a log of this format, or its first part is lost, or the new file already exists.
    """
    # `runs/episodes.recovered.mcap` for `runs/episodes.mcap` and for `runs/episodes.mcap.part`
    target = file.with_name(f"{Path(file.name.removesuffix('.part')).stem}.recovered.mcap")
    # Not overwritten: it may be the result of an earlier recovery, and `file` may have been damaged further.
    if target.exists():
        raise UserError(f"file={file}: {target} already exists")
    damaged: list[str] = []
    writer = _rewrite(file, target, damaged)
    if writer is None:
        raise UserError(f"file={file}: too damaged, what says how it was recorded is lost ({'; '.join(damaged)})")
    return Recovered(writer.finish(), writer.episodes, tuple(damaged))


def taken_over(file: Path, target: Path, policies: int) -> EpisodeWriter | None:
    """A log that goes on after the first `policies` policies of another.

    None if they are not all there; `target` is then not left behind.
    """
    writer = _rewrite(file, target, [], most=policies)
    if writer is not None and writer.policies < policies:
        writer.abandon()
        writer.part.unlink()
        return None
    if writer is not None:
        writer.flush()
    return writer


def _rewrite(file: Path, target: Path, damaged: list[str], most: float = math.inf) -> EpisodeWriter | None:
    """Copy what is whole of the first `most` policies and their episodes."""
    # From front to back, since a log that was cut off has no index: steps and grids are kept until the `/episode`
    # message that closes their episode, which is the last one of it that was written.
    found, writer = _Found(), None
    with container.opened_log(file) as stream:
        for topic, time, data in _whole(stream, found, damaged):
            found.hold(topic, time, data)
            if topic != "/episode":
                continue
            writer = writer or _begin(file, target, found)
            try:
                if writer is None:
                    raise Damaged("what says how it was recorded")
                row = writer.run.checked_row(json.loads(data))
                # Episodes of policies recorded after the checkpoint: the resumed run records them again.
                if row["policy"] >= most:
                    break
                _policies_up_to(row["policy"], writer, found)
                times = int(row["start_time"]), int(row["end_time"])
                steps, grids = (found.between(topic, *times) for topic in ("/step", "/grid"))
                writer.add(decode(row, steps, grids, writer.run))
            # A full disk is no damage of the log that is read: it ends the whole copy.
            except OSError:
                raise
            except Exception as error:  # whatever the content of one episode raises, the next may be whole
                damaged.append(f"an episode after {writer.episodes if writer else 0} whole ones: {reason(error)}")
            found.release()
        writer = writer or _begin(file, target, found)
    # Steps that no `/episode` message closed: the episode that was being written.
    if found.held["/step"] or schema.END not in found.metadata:
        damaged.append("the end is missing")
    if writer is not None:
        # Policies recorded after the last whole episode are copied as well: `taken_over` counts them.
        named = (re.fullmatch(rf"{re.escape(schema.POLICY)}\.([0-9]{{1,6}})", name) for name in found.metadata)
        last = max((int(name[1]) for name in named if name), default=-1)
        try:
            _policies_up_to(int(min(last, most - 1)), writer, found)
        except (Damaged, ValueError, KeyError) as error:
            damaged.append(reason(error))
    return writer


def _whole(stream: Any, found: _Found, damaged: list[str]) -> Iterator[tuple[str, int, bytes]]:
    """The messages of every chunk that is whole; attachments and metadata go to `found`."""
    channels: dict[int, str] = {}
    walk = container.records(stream, len(container.MAGIC))
    while True:
        try:
            # `next` inside the try: damage that `records` finds ends the walk by an exception, after which it yields
            # no more and StopIteration follows; damage within a record is noted, and the walk goes on behind it.
            opcode, body = next(walk)
            if opcode == container.DATA_END:
                return
            if opcode == container.METADATA:
                name, content = container.metadata_of(body)
                # The container has no checksum for metadata; the seal is our own.
                plain = schema.unsealed_record(name, content)
                if plain is None:
                    raise Damaged(f"metadata {name}")
                found.metadata[name] = plain
            elif opcode == container.ATTACHMENT:
                name, attached = container.attachment_of(body)
                found.attachments[name] = attached
            elif opcode == container.CHUNK:
                for message in container.messages_of(container.unpacked(body)[1], channels):
                    yield message.topic, message.log_time, message.data
        except StopIteration:
            return
        except OSError:  # of the disk, which is no damage of the log
            raise
        except Exception as error:  # whatever a record's content raises, the next may be whole
            damaged.append(reason(error))


def _begin(file: Path, target: Path, found: _Found) -> EpisodeWriter | None:
    """The new log, if all that it starts with has been found."""
    if schema.RUN not in found.metadata:
        return None
    run = LoggedRun.of(file, found.metadata[schema.RUN])
    tables = {name: found.attachments.get(name, b"") for name in run.tables}
    # Without the kernel and the prices that it names, the log could not be simulated again; a copy would look whole.
    if any(schema.digest(content) != run.said.get(f"{name}.sha256") for name, content in tables.items()):
        return None
    return EpisodeWriter(target, run, tables)


def _policies_up_to(number: int, writer: EpisodeWriter, found: _Found) -> None:
    """Copy the policies up to `number` that have not been copied."""
    # All up to `number`, since a policy's number is its place: leaving out one that has no episode would shift the
    # rest.
    for each in range(writer.policies, number + 1):
        facts = dict(found.metadata.get(f"{schema.POLICY}.{each}", {}))
        if not facts:
            raise Damaged(f"policy {each} is lost")
        writer.flush()  # as when it was recorded, so that a copy has the same bytes
        writer.run.check_policy(facts)
        sha256, table = facts.pop("table.sha256"), found.attachments.get(writer.run.policy_file(each))
        if sha256 and (table is None or schema.digest(table) != sha256):
            raise Damaged(f"policy {each} is lost")
        writer.copy_policy(facts, table if sha256 else None)
