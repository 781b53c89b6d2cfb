# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium with one page, driven by the DevTools protocol over pipes; also used by the tests of the panel.

The scripts of figures/ take the program that their first argument names, if any, and save pictures with few colours.
"""

import base64
import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NoReturn

from PIL import Image

from place import PICTURES

SETTLED = "new Promise(done => setTimeout(done, 2000))"  #: figures are drawn by then


class Chromium:
    """Browser with one page.

    Args:
        folder: folder of its profile and of saved files.
        program: the browser.

    Attributes:
        told: console messages and uncaught errors of the page.
        asked: addresses that it has requested.
    """

    def __init__(self, folder: Path, program: str = "chromium") -> None:
        self._number = 0
        self.told: list[str] = []
        self.asked: list[str] = []
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()
        words = [program, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--no-first-run"]
        words += ["--disable-background-networking", "--hide-scrollbars", f"--user-data-dir={folder / 'browser'}"]
        shell = f'exec "$@" 3<&{commands} 4>&{answers}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *words], pass_fds=(commands, answers), stderr=subprocess.DEVNULL
        )
        os.close(commands)
        os.close(answers)
        self._rest, self._session = b"", ""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))

    def __enter__(self) -> "Chromium":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._commands)
        os.close(self._answers)

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            self._rest += os.read(self._answers, 2**16) or self._ended()
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _ended(self) -> NoReturn:
        raise RuntimeError(f"chromium has ended with {self._process.wait()}")

    def call(self, method: str, **params: object) -> Any:
        """Call a method of the protocol and return its result."""
        self._number += 1
        question = {"id": self._number, "method": method, "params": params}
        if self._session:
            question["sessionId"] = self._session
        os.write(self._commands, json.dumps(question).encode() + b"\0")
        while True:
            message = self._read()
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            told = message.get("params", {})
            if message["method"] == "Runtime.consoleAPICalled":
                self.told.append(str([each.get("value", each.get("description")) for each in told["args"]]))
            elif message["method"] == "Runtime.exceptionThrown":
                self.told.append(json.dumps(told["exceptionDetails"])[:2000])
            elif message["method"] == "Log.entryAdded":
                self.told.append(told["entry"]["text"])
            elif message["method"] == "Network.requestWillBeSent":
                self.asked.append(told["request"]["url"])

    def look(self, width: int, height: int, *, dark: bool = False) -> None:
        """Set the size of the window and the user's colours."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        wanted = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[wanted])

    def open(self, address: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """Return the value of an expression, after waiting for a promise."""
        found = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, script: str, seconds: float = 60.0) -> Any:
        """Return the first true value of an expression."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if found := self.run(f"(() => {{ try {{ return {script}; }} catch (error) {{ return null; }} }})()"):
                return found
            self.run("new Promise(done => setTimeout(done, 50))")
        raise TimeoutError((script, self.run("document.body?.innerText")))

    def click(self, selector: str) -> None:
        """Click the first element that a selector finds."""
        self.run(f"document.querySelector({json.dumps(selector)}).click()")

    def shot(self) -> Image.Image:
        """Return a picture of the window, or of a longer page."""
        found = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        return Image.open(io.BytesIO(base64.b64decode(found["data"]))).convert("RGB")

    def photograph(self, address: str, size: tuple[int, int], *, dark: bool = False) -> Image.Image:
        """Return the top of a page in a window of a size [px]."""
        self.look(*size, dark=dark)
        self.open(address)
        self.run(SETTLED)
        return self.shot().crop((0, 0, *size))


def shot(page: Path, size: tuple[int, int], *, dark: bool = False) -> Image.Image:
    """Return the top of a page in a file."""
    with Chromium(page.parent, *sys.argv[1:2]) as browser:
        return browser.photograph(page.as_uri(), size, dark=dark)


def light_and_dark(light: Image.Image, dark: Image.Image) -> Image.Image:
    """Return two pictures side by side."""
    both = Image.new("RGB", (2 * light.width + 20, light.height), "#888")
    both.paste(light, (0, 0))
    both.paste(dark, (light.width + 20, 0))
    return both


def save(picture: Image.Image, name: str, colours: int = 96) -> None:
    """Save a picture of docs/img with few colours, so that it stays small."""
    picture.quantize(colours, dither=Image.Dither.NONE).save(PICTURES / f"{name}.png", optimize=True)
