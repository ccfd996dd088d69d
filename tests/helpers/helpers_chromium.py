"""A page in a real browser: headless Chromium, spoken to through a pipe (DevTools protocol)."""

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from typing import Any

import cv2
import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--no-first-run", "--disable-extensions", "--disable-background-networking",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe", "--force-device-scale-factor=1",
)  # fmt: skip

SILENCE = 120
"""Seconds after which a browser that does not answer is taken to be stuck."""


def find_chromium() -> str | None:
    """The browser's path, None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Chromium:
    """One page at a time; `log` holds console messages of level error and uncaught exceptions.

    `requests` holds the addresses that the page asked for, without data addresses.
    """

    def __init__(self, path: str, width: int = 1200, height: int = 800) -> None:
        self.folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        ours, theirs = os.pipe(), os.pipe()

        def give() -> None:
            # the browser reads from 3 and writes to 4
            a, b = os.dup(ours[0]), os.dup(theirs[1])
            os.dup2(a, 3)
            os.dup2(b, 4)

        words = [path, *FLAGS, f"--window-size={width},{height}"]
        self.process = subprocess.Popen(
            [*words, f"--user-data-dir={self.folder.name}"],
            preexec_fn=give,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(ours[0])
        os.close(theirs[1])
        self.write, self.read = os.fdopen(ours[1], "wb", 0), os.fdopen(theirs[0], "rb", 0)
        self.buffer, self.number, self.session = b"", 0, None
        self.log: list[str] = []
        self.requests: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """The result of a command."""
        self.number += 1
        message: dict[str, Any] = {"id": self.number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        self.write.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return dict(answer["result"])
            self._event(answer)

    def open(self, address: str, limit: float = 60.0) -> None:
        """Load a page and wait until it says that it is ready."""
        self.call("Page.navigate", url=address)
        self.wait("document.body && document.body.dataset.ready == 'yes'", limit)

    def wait(self, condition: str, limit: float = 60.0) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + limit
        while not self.value(condition):
            if time.monotonic() > end:
                raise TimeoutError(f"{condition}; console: {self.log}")
            time.sleep(0.05)

    def value(self, expression: str) -> Any:
        """The value of an expression, awaited where it is a promise."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def screenshot(self) -> np.ndarray:
        """(H, W, 3) uint8 RGB of the window."""
        # two frames later, all requested changes are drawn
        self.value("new Promise(d => requestAnimationFrame(() => requestAnimationFrame(d)))")
        data = self.call("Page.captureScreenshot", format="png")
        raw = np.frombuffer(base64.b64decode(data["data"]), np.uint8)
        return np.asarray(cv2.imdecode(raw, cv2.IMREAD_COLOR)[..., ::-1])

    def close(self) -> None:
        """End the browser."""
        self.process.kill()
        self.process.wait()
        self.write.close()
        self.read.close()
        self.folder.cleanup()

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            if not select.select([self.read], [], [], SILENCE)[0]:
                raise TimeoutError(f"the browser says nothing for {SILENCE} s: {self.log}")
            piece = self.read.read(1 << 16)
            if not piece:
                raise RuntimeError("the browser has ended")
            self.buffer += piece
        text, _, self.buffer = self.buffer.partition(b"\0")
        return dict(json.loads(text))

    def _event(self, event: dict[str, Any]) -> None:
        method, params = event.get("method"), event.get("params", {})
        thrown = method == "Runtime.exceptionThrown"
        said = method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert")
        logged = method == "Log.entryAdded" and params["entry"]["level"] == "error"
        if thrown or said or logged:
            self.log.append(str(params))
        elif method == "Network.requestWillBeSent":
            address = params["request"]["url"]
            if not address.startswith(("data:", "blob:")):
                self.requests.append(address)
