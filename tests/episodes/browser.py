"""Headless Chromium, driven over its debugging pipe: nothing but the standard library."""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Any

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


class Browser:
    """One page of one browser; `problems` collects console errors and uncaught exceptions."""

    def __init__(self, folder: Path) -> None:
        self._ids, self.problems = itertools.count(1), list[str]()
        commands, self._write = os.pipe()
        self._read, answers = os.pipe()
        flags = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
        ]
        flags += [
            "--remote-debugging-pipe",
            f"--user-data-dir={folder}",
            "--host-resolver-rules=MAP * ~NOTFOUND",
        ]

        def numbered() -> None:
            high = [os.dup(commands), os.dup(answers)]
            os.dup2(high[0], 3)
            os.dup2(high[1], 4)

        assert CHROMIUM
        self._process = subprocess.Popen(
            [CHROMIUM, *flags, "about:blank"],
            preexec_fn=numbered,
            close_fds=False,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(answers)
        self._rest, self._session = b"", None
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        os.close(self._write)
        self._process.terminate()
        self._process.wait()
        os.close(self._read)

    def _call(self, method: str, **parameters: Any) -> Any:
        number = next(self._ids)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            more = os.read(self._read, 65536)
            assert more, "the browser is gone"
            self._rest += more
        text, self._rest = self._rest.split(b"\0", 1)
        answer: dict[str, Any] = json.loads(text)
        return answer

    def _note(self, event: dict[str, Any]) -> None:
        method, said = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(said["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning"):
            self.problems.append(json.dumps(said["args"]))
        elif method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.problems.append(said["entry"]["text"])
        elif method == "Network.requestWillBeSent" and not said["request"]["url"].startswith(
            ("file:", "data:")
        ):
            self.problems.append(f"request of {said['request']['url']}")

    def view(self, width: int, height: int, scheme: str) -> None:
        """A window of this size in the `light` or `dark` scheme."""
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 500,
        )
        self._call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": scheme}],
        )

    def open(self, file: Path) -> None:
        """Load a page and wait until it has run."""
        self._call("Page.navigate", url=file.as_uri())
        while self.ask("document.readyState") != "complete" or not self.ask(
            "location.href"
        ).startswith("file:"):
            pass

    def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression; a promise is waited for."""
        answer = self._call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def smallest_letters(self) -> float:
        """The height of the smallest text of all drawings, in pixels."""
        scale = "((to) => Math.hypot(to.a, to.b))(text.getScreenCTM())"  # of the drawing, turned text included
        size = f"parseFloat(getComputedStyle(text).fontSize) * {scale}"
        return float(
            self.ask(
                f"Math.min(...[...document.querySelectorAll('svg text')].map((text) => {size}))"
            )
        )

    def touching_letters(self) -> list[str]:
        """Pairs of texts of one drawing that lie on each other."""
        apart = "a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top"
        # Boxes have room above and below the letters, so that a quarter of the height is let go of.
        box = "(({left, right, top, bottom, height: h}) => ({left, right, top: top + h / 4, bottom: bottom - h / 4}))"
        found: list[str] = self.ask(
            f"""[...document.querySelectorAll("svg")].flatMap((svg) => {{
              const every = [...svg.querySelectorAll("text")].filter((text) => text.textContent.trim());
              const boxes = every.map((text) => {box}(text.getBoundingClientRect()));
              return boxes.flatMap((a, i) => boxes.slice(i + 1).flatMap((b, j) =>
                {apart} ? [] : [every[i].textContent + " | " + every[i + 1 + j].textContent]));
            }})"""
        )
        return found

    def press(self, key: str) -> None:
        """A key, as the keyboard sends it."""
        code = {" ": 32, "ArrowLeft": 37, "ArrowRight": 39, "Home": 36, "End": 35}.get(
            key, ord(key[0])
        )
        text = {"text": key} if len(key) == 1 else {}
        self._call(
            "Input.dispatchKeyEvent", type="keyDown", key=key, windowsVirtualKeyCode=code, **text
        )
        self._call("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)

    def shoot(self, file: Path) -> None:
        """A picture of the whole page."""
        data = self._call("Page.captureScreenshot", captureBeyondViewport=True)["data"]
        file.write_bytes(base64.b64decode(data))
