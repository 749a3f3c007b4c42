"""A page in headless Chromium, driven through its devtools: open, wait, evaluate, take a picture. Software rendering, no network.

page = Page("http://127.0.0.1:8080")
page.wait_for("document.title")
page.picture(Path("view.png"))
page.close()
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_FLAGS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--hide-scrollbars", "--remote-debugging-port=0",
)  # fmt: skip
_HEARD = ("Runtime.consoleAPICalled", "Log.entryAdded", "Runtime.exceptionThrown", "Network.requestWillBeSent")


def find_chromium() -> str | None:
    """Return the browser's path, or None where there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Page:
    """One page; `close` ends its browser.

    Attributes:
        events: What console, log and network said so far.
    """

    def __init__(self, url: str, width: int = 1280, height: int = 800, patience: float = 60.0) -> None:
        """Open a page of this size [px]; nothing may take longer than `patience` [s]."""
        from websockets.sync.client import connect

        browser = find_chromium()
        if browser is None:
            raise RuntimeError("no chromium on the path")
        self._patience, self._n, self.events = patience, 0, []
        self._folder = tempfile.mkdtemp(prefix="page")
        command = [
            browser,
            *_FLAGS,
            f"--user-data-dir={self._folder}",
            f"--window-size={width},{height}",
            "about:blank",
        ]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = self._port()
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=patience) as answer:
                tab = next(t for t in json.load(answer) if t["type"] == "page")
            self._socket = connect(tab["webSocketDebuggerUrl"], max_size=None, ping_interval=None)
            for domain in ("Runtime", "Log", "Page", "Network"):
                self.call(f"{domain}.enable")
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            self.call("Emulation.setDeviceMetricsOverride", **size)
            self.call("Page.navigate", url=url)
        except BaseException:
            self._end()
            raise

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the devtools and return its result."""
        self._n += 1
        number = self._n
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(self._patience))
            if message.get("id") == number:
                return message.get("result", message)
            self._hear(message)

    def evaluate(self, expression: str) -> Any:
        """Return what JavaScript evaluates to."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression: str) -> bool:
        """Wait until JavaScript is true; return whether it became so in time."""
        end = time.monotonic() + self._patience
        while time.monotonic() < end:
            if self.evaluate(f"Boolean({expression})"):
                return True
            self.wait(0.2)
        return False

    def wait(self, seconds: float) -> None:
        """Let time pass, and hear what the page says."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                self._hear(json.loads(self._socket.recv(left)))
            except TimeoutError:
                return

    def picture(self, path: Path) -> None:
        """Write the page as it is now, as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def errors(self) -> list[str]:
        """Return what console and log called an error, and exceptions."""
        found = []
        for event in self.events:
            method, said = event["method"], event["params"]
            kind = said.get("type") or said.get("entry", {}).get("level")
            if method == "Runtime.exceptionThrown" or (kind == "error" and method != "Network.requestWillBeSent"):
                found.append(json.dumps(said)[:500])
        return found

    def requests(self) -> list[str]:
        """Return the addresses that the page asked for."""
        return [e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"]

    def close(self) -> None:
        """End the browser."""
        self._socket.close()
        self._end()

    def _hear(self, message: dict[str, Any]) -> None:
        if message.get("method") in _HEARD:
            self.events.append(message)

    def _port(self) -> str:
        said, end = Path(self._folder) / "DevToolsActivePort", time.monotonic() + self._patience
        while time.monotonic() < end:
            if said.exists() and (words := said.read_text().split()):
                return words[0]
            time.sleep(0.05)
        raise RuntimeError("chromium did not start")

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)
