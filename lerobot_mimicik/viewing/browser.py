"""A Chromium without a window, by its debugging protocol: looks at a page, takes its picture, moves its mouse."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import ClientConnection, connect

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_START_S, _ANSWER_S = 240.0, 240.0  # a busy machine takes its time
_FLAGS = (
    "--headless=new",
    "--no-sandbox",  # containers run as root
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    # WebGL without a graphics card.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)


def find_chromium() -> str | None:
    """The path of an installed Chromium or Chrome; None where there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page of a headless Chromium; ends with the `with` that it is used in.

    Attributes:
        errors: Errors that the page wrote to its console or raised, so far.
    """

    def __init__(self, url: str, width: int = 1280, height: int = 800) -> None:
        """Start the browser and open a page.

        Raises:
            FileNotFoundError: No Chromium is installed.
            TimeoutError: It does not start, or does not answer.
        """
        program = find_chromium()
        if program is None:
            raise FileNotFoundError(f"no Chromium is installed: none of {', '.join(_NAMES)} is on the path")
        self.errors: list[str] = []
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [
                program,
                *_FLAGS,
                f"--user-data-dir={self._folder.name}",
                f"--window-size={width},{height}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._number = 0
        self._socket: ClientConnection | None = None
        try:
            self._socket = connect(self._page_address(), max_size=None)
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            for method, options in (
                ("Runtime.enable", {}),
                ("Log.enable", {}),
                ("Page.enable", {}),
                ("Emulation.setDeviceMetricsOverride", size),
                ("Page.navigate", {"url": url}),
            ):
                self.ask(method, **options)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the browser."""
        if self._socket is not None:
            self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()

    def ask(self, method: str, **options: Any) -> dict[str, Any]:
        """Call a method of the protocol; what it answers.

        Raises:
            RuntimeError: The browser refuses.
            TimeoutError: It does not answer.
        """
        assert self._socket is not None
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": options}))
        until = time.monotonic() + _ANSWER_S
        while True:
            message = json.loads(self._socket.recv(timeout=max(0.0, until - time.monotonic())))
            self._listen(message)
            if message.get("id") == self._number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error'].get('message')}")
                return dict(message.get("result", {}))

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript in the page."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer.get("result", {}).get("value")

    def wait_for_drawing(self, seconds: float = 1.0) -> None:
        """Return once what has arrived is drawn and what fades has faded."""
        code = f"new Promise(done => setTimeout(() => requestAnimationFrame(done), {1e3 * seconds:.0f}))"
        self.ask("Runtime.evaluate", expression=code, awaitPromise=True)

    def mouse(self, kind: str, x: float, y: float) -> None:
        """`mouseMoved`, `mousePressed` or `mouseReleased` at a point of the page, the left button where one is needed."""
        button = "none" if kind == "mouseMoved" else "left"
        self.ask(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=int(button == "left")
        )

    def picture(self, path: str | Path) -> None:
        """Write what the page looks like as PNG."""
        data = self.ask("Page.captureScreenshot", format="png")["data"]
        Path(path).write_bytes(base64.b64decode(data))

    def _listen(self, message: dict[str, Any]) -> None:
        method, told = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(str(told["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and told.get("type") in ("error", "assert"):
            self.errors.append(" ".join(str(each.get("value", each)) for each in told.get("args", [])))
        elif method == "Log.entryAdded" and told["entry"].get("level") == "error":
            self.errors.append(str(told["entry"].get("text")))

    def _page_address(self) -> str:
        """The address of the page's debugger, once the browser has written its port."""
        file = Path(self._folder.name) / "DevToolsActivePort"
        until = time.monotonic() + _START_S
        while time.monotonic() < until and self._process.poll() is None:
            if file.is_file() and file.read_text().strip():
                port = int(file.read_text().split()[0])
                with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=_ANSWER_S) as answer:
                    pages = [each for each in json.load(answer) if each["type"] == "page"]
                if pages:
                    return str(pages[0]["webSocketDebuggerUrl"])
            time.sleep(0.05)
        raise TimeoutError("Chromium did not start, or opened no page")
