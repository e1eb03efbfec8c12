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

"""The server of the page: what it sends, what it answers, and whom it lets in."""

from __future__ import annotations

import asyncio
import io
import json
import struct
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.viewer.plain_words import explain
from semcal_ros.viewer.server import PageServer
from semcal_ros.viewer.source import DriftPanel, Status, View
from semcal_ros.viewer.state import describe_magnification
from tests.helpers.node_scenes import make_calibration, texture

CALIBRATION = make_calibration()
CAMERA = CALIBRATION.at(2000.0)
RAW = texture(3).astype(np.uint16) * 16
MOVING = (((1, 2), (3, 2), (3, 5)),)


class Source:
    """A stream of one frame."""

    def __init__(self) -> None:
        self.pages: list[int] = []
        self.acts: list[tuple[str, float | tuple[float, ...] | None]] = []
        pictures: dict[str, NDArray[Any]] = {"raw": RAW, "corrected": RAW[::-1].copy()}
        self.view = View(
            1, 1_700_000_000 * 10**9, pictures, CAMERA, True, (2.0, 1.0), moving=MOVING
        )

    def watch(self, pages: int) -> None:
        self.pages.append(pages)

    def newest(self) -> View | None:
        return self.view

    def overlay(self) -> NDArray[Any] | None:
        return None

    def describe(self) -> Status:
        at = describe_magnification(2000.0, CALIBRATION)
        return Status("test", "live", at, (), explain([]), DriftPanel("none"), ("reset", "stop"))

    def act(self, action: str, value: float | tuple[float, ...] | None) -> str:
        self.acts.append((action, value))
        if action == "stop":
            raise InvalidValueError("it will not stop", do="pull the plug")
        return "the next frame has zero drift"


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture
def server(source: Source) -> Iterator[PageServer]:
    made = PageServer(source)
    made.start()
    yield made
    made.stop()


def get(url: str, headers: dict[str, str] | None = None) -> tuple[int, Any, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers or {})) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers, error.read()


def talk(
    server: PageServer, messages: list[dict[str, Any]], wanted: int, headers: Any = None
) -> list[Any]:
    """Answers that are neither pictures nor states, or with no messages the first things that come."""

    async def run() -> list[Any]:
        request = HTTPRequest(f"ws://127.0.0.1:{server.port}/live", headers=headers)
        page = await websocket_connect(request)
        for message in messages:
            await page.write_message(json.dumps(message))
        found: list[Any] = []
        while len(found) < wanted:
            told = await asyncio.wait_for(page.read_message(), 20)
            assert told is not None
            if not messages or (isinstance(told, str) and json.loads(told)["type"] != "status"):
                found.append(told if isinstance(told, bytes) else json.loads(told))
        page.close()
        # Until the other side has agreed: a socket that is merely left is a warning.
        while await asyncio.wait_for(page.read_message(), 20) is not None:
            pass
        return found

    return asyncio.run(run())


def test_the_page_has_all_it_needs_and_takes_nothing_from_elsewhere(server: PageServer) -> None:
    status, headers, body = get(f"http://localhost:{server.port}/")
    assert status == 200
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    text = body.decode()
    for name in ("app.js", "style.css", "icon.svg"):
        assert name in text
        assert get(f"http://localhost:{server.port}/{name}")[0] == 200
    assert "http" not in text
    for wrong in ("/nothing", "/../server.py", "/page/app.js", "/index.html"):
        assert get(f"http://localhost:{server.port}{wrong}")[0] in (403, 404)


def test_state_and_pictures_come(server: PageServer, source: Source) -> None:
    state, picture = talk(server, [], 2)
    assert state["magnification"]["explanation"] == "calibrated, 500× to 8000×"
    (size,) = struct.unpack_from("<I", picture)
    header = json.loads(picture[4 : 4 + size])
    assert [p["name"] for p in header["pictures"]] == ["raw", "corrected"]
    assert len(picture) == 4 + size + sum(p["bytes"] for p in header["pictures"])
    assert picture[4 + size : 4 + size + 2] == b"\xff\xd8"
    scale = header["pictures"][0]["scale"]
    assert scale["nm_per_px"] == pytest.approx(1e9 * CAMERA.rectified.pixel_size_m[0])
    assert "±" in scale["bar_label"]
    assert header["drift_px"] == [2.0, 1.0]
    assert header["moving"] == [[[1, 2], [3, 2], [3, 5]]]
    assert source.pages[0] == 1
    assert source.pages[-1] == 0


def test_lengths_are_measured(server: PageServer) -> None:
    asked = {"type": "measure", "of": "ruler", "picture": "raw", "start": [10, 10], "end": [60, 10]}
    (told,) = talk(server, [asked], 1)
    assert told["type"] == "measured"
    assert told["of"] == "ruler"
    assert told["length_nm"] == pytest.approx(50e9 * CAMERA.rectified.pixel_size_m[0], rel=0.1)
    assert "µm" in told["text"]
    assert "calibration" in told["why"]


def test_buttons_are_passed_on_and_refusals_come_back(server: PageServer, source: Source) -> None:
    told = talk(server, [{"type": "act", "action": "reset"}, {"type": "act", "action": "stop"}], 2)
    answers = {one["action"]: one for one in told}
    assert answers["reset"]["success"]
    assert answers["reset"]["text"] == "the next frame has zero drift"
    assert not answers["stop"]["success"]
    assert "pull the plug" in answers["stop"]["text"]
    assert set(source.acts) == {("reset", None), ("stop", None)}
    goal = {"type": "act", "action": "acquire", "value": [500, 1e4, 0.001]}
    assert talk(server, [goal], 1)[0]["success"]
    assert source.acts[-1] == ("acquire", (500.0, 10000.0, 0.001))


@pytest.mark.parametrize(
    "wrong",
    [
        {"type": "act", "action": "move_stage"},
        {"type": "act"},
        {"type": "act", "action": "acquire", "value": [500, "much"]},
        {"type": "request", "zoom": "large"},
        {"type": "request", "contrast": {"mode": "fixed", "low": 9, "high": 3}},
        {"type": "request", "pictures": ["x"]},
        {"type": "request", "centre": [1]},
        {"type": "measure", "picture": "raw", "end": [1, None]},
        {"type": "measure", "picture": "other", "end": [1, 2]},
        {"type": "unheard of"},
        {},
    ],
)
def test_wrong_messages_are_refused_in_words(
    server: PageServer, source: Source, wrong: dict[str, Any]
) -> None:
    (told,) = talk(server, [wrong], 1)
    assert told["type"] == "refused"
    assert told["text"]
    assert not source.acts


def test_a_browser_that_shows_nothing_is_sent_nothing(server: PageServer, source: Source) -> None:
    """Pictures are left out until the last one has been shown."""

    async def run() -> int:
        page = await websocket_connect(f"ws://127.0.0.1:{server.port}/live")
        count, seen = 0, 0
        for number in range(2, 12):
            source.view = View(number, number, source.view.pictures, CAMERA, True)
            await asyncio.sleep(0.12)
        page.close()
        while (told := await page.read_message()) is not None:
            seen += 1
            count += isinstance(told, bytes)
        assert seen > count
        return count

    assert asyncio.run(run()) == 1


def test_a_snapshot_is_the_picture_at_full_depth_with_its_scale(server: PageServer) -> None:
    status, headers, body = get(f"http://localhost:{server.port}/snapshot?picture=raw")
    assert status == 200
    assert 'filename="raw_2000x_20231114T221320_000000.tif"' in headers["Content-Disposition"]
    with tifffile.TiffFile(io.BytesIO(body)) as file:
        np.testing.assert_array_equal(file.asarray(), RAW)
        text = file.ome_metadata or ""
    assert "PhysicalSizeX" in text
    for said in ("pixel_size_sigma_m", "magnification", "calibrated"):
        assert said in text
    assert get(f"http://localhost:{server.port}/snapshot?picture=best")[0] == 404


# -- who may come in ---------------------------------------------------------------------------------


def test_a_strangers_name_for_this_computer_is_refused(server: PageServer) -> None:
    url = f"http://127.0.0.1:{server.port}/"
    assert get(url)[0] == 200
    assert get(url, {"Host": "evil.example"})[0] == 403
    with pytest.raises(HTTPClientError) as refusal:
        talk(server, [], 1, {"Host": "evil.example"})
    assert refusal.value.code == 403


def test_a_page_from_elsewhere_cannot_use_the_socket(server: PageServer) -> None:
    with pytest.raises(HTTPClientError) as refusal:
        talk(server, [], 1, {"Origin": "http://evil.example"})
    assert refusal.value.code == 403


def test_another_host_asks_for_the_token(source: Source) -> None:
    server = PageServer(source, "0.0.0.0", token="sesame")
    server.start()
    try:
        url = f"http://127.0.0.1:{server.port}"
        assert server.address.endswith("/?token=sesame")
        for path in ("/", "/app.js", "/snapshot?picture=raw", "/?token=guess"):
            status, _, body = get(url + path)
            assert (status, b"token" in body) == (401, True)
        with pytest.raises(HTTPClientError) as refusal:
            talk(server, [], 1)
        assert refusal.value.code == 403
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        with opener.open(url + "/?token=sesame") as answer:
            assert answer.status == 200
            # Moved into a cookie, so that it is not seen in the address.
            assert "token" not in answer.url
        with opener.open(url + "/app.js") as answer:
            assert answer.status == 200
        cookie = {"Cookie": f"{server.cookie}=sesame"}
        assert talk(server, [], 1, cookie)[0]["type"] == "status"
    finally:
        server.stop()


def test_a_token_is_made_up_where_none_is_given(source: Source) -> None:
    servers = [PageServer(source, "0.0.0.0") for _ in range(2)]
    tokens = {server.token for server in servers}
    for server in servers:
        server.stop()
    assert len(tokens) == 2
    assert min(map(len, tokens)) >= 16


def test_an_address_that_is_taken_is_refused_in_words(server: PageServer, source: Source) -> None:
    with pytest.raises(InvalidValueError, match="--port"):
        PageServer(source, "127.0.0.1", server.port)
    with pytest.raises(InvalidValueError, match="cannot listen"):
        PageServer(source, "no-such-host.invalid", 0)
