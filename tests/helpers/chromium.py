# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A headless Chromium, driven by its DevTools protocol over the WebSocket client of tornado."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

BROWSER = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)
# A start on a busy machine takes seconds.
START_S = 60.0
ANSWER_S = 30.0


class Page:
    """One page. Everything that its console says is kept in ``console``, and so are all requests that failed."""

    def __init__(self, loop: asyncio.AbstractEventLoop, connection: WebSocketClientConnection):
        self._loop, self._connection = loop, connection
        self._number = 0
        self.console: list[str] = []

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._loop.run_until_complete(
            asyncio.wait_for(self._call(method, parameters), ANSWER_S)
        )

    async def _call(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        self._number += 1
        number = self._number
        text = json.dumps({"id": number, "method": method, "params": parameters})
        await self._connection.write_message(text)
        while True:
            message = await self._connection.read_message()
            assert message is not None, "the browser has gone"
            answer = json.loads(message)
            if answer.get("id") == number:
                assert "error" not in answer, answer["error"]
                return dict(answer["result"])
            self._note(answer)

    def _note(self, event: dict[str, Any]) -> None:
        parameters = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            self.console.append(json.dumps(parameters["exceptionDetails"])[:600])
        elif event.get("method") == "Runtime.consoleAPICalled":
            self.console.append(json.dumps(parameters["args"])[:600])
        elif event.get("method") == "Log.entryAdded":
            entry = parameters["entry"]
            self.console.append(f"{entry['level']}: {entry['text']} {entry.get('url', '')}")

    def size(self, width: int, height: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def evaluate(self, expression: str) -> Any:
        done = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def wait_for(self, expression: str, timeout_s: float = 30.0) -> Any:
        """Wait until an expression is true, and return its value."""
        deadline = time.monotonic() + timeout_s
        # While a page is being loaded, what the expression asks for may not be there yet.
        guarded = f"(() => {{ try {{ return {expression}; }} catch {{ return null; }} }})()"
        while not (value := self.evaluate(guarded)):
            assert time.monotonic() < deadline, f"{expression} stays {value!r}"
            time.sleep(0.05)
        return value

    def text(self, selector: str) -> str:
        return str(self.evaluate(f"document.querySelector({json.dumps(selector)}).textContent"))

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Bring an element into view; its x, y, width and height in the window."""
        return tuple(  # type: ignore[return-value]
            self.evaluate(
                f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
                " e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
                " return [b.x, b.y, b.width, b.height]; })()"
            )
        )

    def click(self, selector: str) -> None:
        """Click with the mouse on what is seen there, not with a script on the element."""
        x, y, width, height = self.box(selector)
        self.drag([(x + width / 2, y + height / 2)])

    def drag(self, way: list[tuple[float, float]]) -> None:
        """Press the mouse at the first place, move along, and release it at the last."""
        (x, y), last = way[0], way[-1]
        mouse = "Input.dispatchMouseEvent"
        button = {"button": "left", "clickCount": 1}
        self.call(mouse, type="mouseMoved", x=x, y=y)
        self.call(mouse, type="mousePressed", x=x, y=y, **button)
        for x, y in way[1:]:
            self.call(mouse, type="mouseMoved", x=x, y=y, button="left", buttons=1)
        self.call(mouse, type="mouseReleased", x=last[0], y=last[1], **button)

    def download(self, selector: str, folder: Path) -> Path:
        """Click on a link that downloads a file; the file, once it is complete."""
        before = set(folder.iterdir())
        self.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
        self.click(selector)
        deadline = time.monotonic() + ANSWER_S
        while True:
            new = [path for path in set(folder.iterdir()) - before if path.suffix != ".crdownload"]
            if new:
                return new[0]
            assert time.monotonic() < deadline, "no file has come"
            time.sleep(0.05)

    def type(self, selector: str, text: str) -> None:
        """Put text in place of what stands in a field, as a keyboard does."""
        self.click(selector)
        self.evaluate(f"document.querySelector({json.dumps(selector)}).select()")
        self.call("Input.insertText", text=text)

    def screenshot(self, path: Path, *, whole: bool = False) -> None:
        done = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(done["data"]))


async def _close(connection: WebSocketClientConnection) -> None:
    """Close, and wait until the other side has agreed; tornado warns of a connection that is merely left."""
    connection.close()
    while await asyncio.wait_for(connection.read_message(), ANSWER_S) is not None:
        pass


@contextmanager
def chromium(profile: Path) -> Iterator[Page]:
    """A page in a browser without any network but this computer."""
    assert BROWSER is not None
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    options += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1"]
    options += ["--no-first-run", "--disable-background-networking", "--remote-debugging-port=0"]
    # Pictures are drawn as in a window that somebody looks at.
    options += ["--disable-backgrounding-occluded-windows", "--disable-renderer-backgrounding"]
    process = subprocess.Popen(
        [BROWSER, *options, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    loop = asyncio.new_event_loop()
    try:
        port_file = profile / "DevToolsActivePort"
        deadline = time.monotonic() + START_S
        while not (port_file.exists() and len(port_file.read_text().splitlines()) == 2):
            assert process.poll() is None, "the browser has ended"
            assert time.monotonic() < deadline, "the browser does not start"
            time.sleep(0.05)
        port, path = port_file.read_text().split()

        async def connect() -> Page:
            browser = await websocket_connect(f"ws://127.0.0.1:{port}{path}")
            first = Page(loop, browser)
            made = await first._call("Target.createTarget", {"url": "about:blank"})
            await _close(browser)
            address = f"ws://127.0.0.1:{port}/devtools/page/{made['targetId']}"
            # A picture of a page is a message of megabytes.
            return Page(loop, await websocket_connect(address, max_message_size=1 << 28))

        page = loop.run_until_complete(connect())
        for domain in ("Page", "Runtime", "Log"):
            page.call(f"{domain}.enable")
        yield page
        loop.run_until_complete(_close(page._connection))
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        loop.close()
