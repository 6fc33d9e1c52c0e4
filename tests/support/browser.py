"""A page in headless Chromium, driven by the DevTools protocol over a pipe; no package is needed
for it.
"""

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
needs_browser = pytest.mark.skipif(
    not CHROMIUM or not shutil.which("bash"), reason="no Chromium here: apt-get install chromium"
)
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--remote-debugging-pipe",  # no port that another test could take
)
SETTLE_S = 0.4  # after an event: the page draws in the next frame
LOADING_S = 60.0


class Page:
    """A page with its console. Positions are in CSS pixels of the window."""

    def __init__(self, send: Any, receive: Any) -> None:
        self._to = send
        self._from = receive
        self._number = 0
        self.errors: list[str] = []  # of the console, and exceptions
        self.requests: list[str] = []  # addresses that the page asked for
        (target,) = (
            each for each in self._ask("Target.getTargets")["targetInfos"] if each["type"] == "page"
        )
        attached = self._ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def open(self, path: Path, width: int, height: int = 900, *, is_mobile: bool = False) -> None:
        screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": is_mobile}
        self.ask("Emulation.setDeviceMetricsOverride", **screen)
        if is_mobile:
            self.ask("Emulation.setTouchEmulationEnabled", enabled=True)
        self.ask("Page.navigate", url=path.resolve().as_uri())
        until = time.monotonic() + LOADING_S
        while self.value("document.readyState") != "complete" and time.monotonic() < until:
            time.sleep(0.1)
        time.sleep(SETTLE_S)

    def value(self, expression: str) -> Any:
        """Return the JSON value of a JavaScript expression."""
        found = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Dispatch a mouse event: moved, pressed, released or wheel."""
        self.ask("Input.dispatchMouseEvent", type=f"mouse{kind.capitalize()}", x=x, y=y, **more)

    def drag(self, x: float, y: float, dx: float, dy: float = 0.0) -> None:
        self.mouse("moved", x, y)
        self.mouse("pressed", x, y, button="left", buttons=1, clickCount=1)
        # Several moves, as a hand makes them: a page may ignore a single jump.
        for step in (0.25, 0.5, 0.75, 1.0):
            self.mouse("moved", x + step * dx, y + step * dy, button="left", buttons=1)
        self.mouse("released", x + dx, y + dy, button="left", clickCount=1)
        time.sleep(SETTLE_S)

    def click(self, x: float, y: float, times: int = 1) -> None:
        for _ in range(times):
            self.mouse("pressed", x, y, button="left", buttons=1, clickCount=1)
            self.mouse("released", x, y, button="left", clickCount=1)
        time.sleep(SETTLE_S)

    def touch(self, *moments: Sequence[tuple[float, float]]) -> None:
        """Put fingers on the screen, move them through the moments, and lift them."""
        for number, fingers in enumerate(moments):
            points = [{"x": x, "y": y, "id": each} for each, (x, y) in enumerate(fingers)]
            kind = "touchMove" if number else "touchStart"
            self.ask("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        self.ask("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        time.sleep(SETTLE_S)

    def screenshot(self) -> bytes:
        """Return the window as PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot")["data"])

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._ask(method, self._session, **parameters)

    def _ask(self, method: str, session: str = "", **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        self._to.write(json.dumps(message).encode() + b"\0")  # a zero byte ends each message
        self._to.flush()
        while (answer := self._read()).get("id") != self._number:
            self._note(answer)
        assert "error" not in answer, (method, answer)
        return answer["result"]

    def _read(self) -> dict[str, Any]:
        data = bytearray()
        while (letter := self._from.read(1)) != b"\0":
            assert letter, "the browser has ended"
            data += letter
        return json.loads(data)

    def _note(self, event: dict[str, Any]) -> None:
        told = event.get("params", {})
        if event["method"] == "Runtime.exceptionThrown":
            self.errors.append(str(told["exceptionDetails"]))
        elif event["method"] == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"):
            self.errors.append(told["entry"]["text"])
        elif event["method"] == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning"):
            self.errors.append(str(told["args"]))
        elif event["method"] == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"][:200])


@contextmanager
def opened_browser() -> Iterator[Page]:
    """Start Chromium without a window, and end it afterwards."""
    commands, send = os.pipe()
    receive, answers = os.pipe()
    with TemporaryDirectory(ignore_cleanup_errors=True) as home:
        # The browser reads commands from descriptor 3 and writes answers to 4.
        line = f'exec "$@" 3<&{commands} 4>&{answers}'
        words = [
            "bash",
            "-c",
            line,
            "bash",
            CHROMIUM,
            *OPTIONS,
            f"--user-data-dir={home}",
            "about:blank",
        ]
        browser = subprocess.Popen(
            words,
            pass_fds=(commands, answers),
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(answers)
        try:
            with open(send, "wb") as to, open(receive, "rb") as back:  # noqa: PTH123  descriptors
                yield Page(to, back)
        finally:
            browser.kill()
            browser.wait()
