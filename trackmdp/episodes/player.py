"""Playing an episode: with keys at a terminal, as plain text when piped."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.live import Live
from rich.text import Text

from trackmdp.episodes.episode import Episode
from trackmdp.episodes.frame import LEGEND, frame, sentence
from trackmdp.world.model import Task

KEYS = "space pause   ← → step   + - speed   home end   q quit"
_ARROWS = {"\x1b[C": "l", "\x1b[D": "h", "\x1b[H": "0", "\x1b[F": "$", "\x1b[1~": "0", "\x1b[4~": "$"}


@dataclass
class Playing:
    """Where the player is: step, speed (steps per second), whether it moves on by itself."""

    steps: int
    speed: float
    t: int = 0
    paused: bool = False
    over: bool = False

    def press(self, key: str) -> None:
        """Do what a key asks for."""
        key = _ARROWS.get(key, key)
        if key == " ":
            self.paused = not self.paused
            if not self.paused and self.t == self.steps - 1:
                self.t = 0
        elif key in ("l", "h"):
            self.paused, self.t = True, min(max(self.t + (1 if key == "l" else -1), 0), self.steps - 1)
        elif key in ("0", "$"):
            self.paused, self.t = True, 0 if key == "0" else self.steps - 1
        elif key in ("+", "-"):
            self.speed = min(max(self.speed * (2 if key == "+" else 0.5), 0.25), 256)
        elif key in ("q", "\x1b", "\x03"):
            self.over = True

    def tick(self) -> None:
        """Move on by one step; stay at the last, paused."""
        if self.paused:
            return
        self.t = min(self.t + 1, self.steps - 1)
        self.paused = self.t == self.steps - 1


def play(console: Console, episode: Episode, task: Task, speed: float) -> None:
    """Show an episode until it is quit, or all its steps as text where there is no terminal to play at."""
    if not (console.is_terminal and sys.stdin.isatty()):
        for t in range(len(episode)):
            console.print(f"{sentence(episode, t, task)}\n{frame(episode, t, task)}", markup=False)
        console.print(LEGEND, markup=False)
        return
    state = Playing(len(episode), speed)
    with _keys() as descriptor, Live(console=console, auto_refresh=False, screen=True) as live:
        due = time.monotonic() + 1 / state.speed
        while not state.over:
            live.update(Text(_screen(episode, state, task)), refresh=True)
            key = _key(descriptor, max(0.0, due - time.monotonic()) if not state.paused else None)
            if key:
                state.press(key)
            if not key or key == " ":
                state.tick()
            due = time.monotonic() + 1 / state.speed if not key or key == " " else due


def _screen(episode: Episode, state: Playing, task: Task) -> str:
    moves = "paused" if state.paused else f"{state.speed:g} steps/s"
    text = sentence(episode, state.t, task)
    return f"{text}\n\n{frame(episode, state.t, task)}\n\n{LEGEND}\n{moves}   {KEYS}"


@contextmanager
def _keys() -> Iterator[int]:
    """Standard input without echo and without waiting for Enter; as it was afterwards."""
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield descriptor
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _key(descriptor: int, timeout: float | None) -> str:
    """The next key, escape sequences whole; empty after `timeout` seconds without one."""
    ready, _, _ = select.select([descriptor], [], [], timeout)
    # At most 8 bytes at once: an arrow key sends three (ESC [ C), and read one by one its first would count as ESC.
    return os.read(descriptor, 8).decode("utf-8", "replace") if ready else ""
