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

"""The server of the page: files, pictures and state over one WebSocket, with its messages; snapshots over HTTP."""

from __future__ import annotations

import asyncio
import errno
import hmac
import json
import logging
import math
import secrets
import socket
import struct
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tornado import httpserver, web, websocket

from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.files.images.scale_bar import choose_scale_bar, format_length
from semcal_ros.files.images.write import PixelScale, pixel_scale, write_image
from semcal_ros.viewer.measure import (
    PICTURES,
    Distance,
    digits_of,
    format_with_sigma,
    measure_distance,
)
from semcal_ros.viewer.pictures import (
    Contrast,
    Levels,
    Region,
    choose_levels,
    choose_region,
    encode_picture,
)
from semcal_ros.viewer.source import ACTIONS, View, ViewSource

# A page that asks for more gets this: the longest side of a screen with room to spare.
_LARGEST_WIDTH_PX = 4096

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
"""Names of this computer by which only its own users come in; no token is asked of them."""

_PAGE = Path(__file__).parent / "page"
# Enough to focus by; the stream needs the processor. Pictures are made in this part of the time at most: where they are
# large, or where others want the processor and the stream is late, fewer are sent, down to two a second.
_PICTURE_INTERVAL_S = 0.2
_PICTURE_SHARE = 0.025
_LONGEST_INTERVAL_S = 0.5
_STATUS_INTERVAL_S = 0.4
# How often a connection looks for something new: well below the interval of the pictures.
_POLL_S = 0.04
# A browser that has not shown a picture for so long has lost it, or sleeps; it gets another one.
_PATIENCE_S = 3.0
# Messages of the page are a few hundred bytes.
_LARGEST_MESSAGE = 1 << 16
# An older clock than this is that of a replay; see the nodes' reporter.
_OTHER_CLOCK_S = 3600.0
_HEADERS = {
    # Nothing from elsewhere: the page works without any network.
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class PageRequest:
    """What a page wants to see.

    Attributes
    ----------
    pictures
        Which of :data:`~semcal_ros.viewer.measure.PICTURES`.
    width_px
        How many pixels it has for each.
    contrast, zoom, centre
        As :mod:`semcal_ros.viewer.pictures` takes them.
    """

    pictures: tuple[str, ...] = PICTURES
    width_px: int = 640
    contrast: Contrast = field(default_factory=Contrast)
    zoom: float = 1.0
    centre: tuple[float, float] = (0.5, 0.5)


def _number(value: Any, name: str) -> float:
    # JSON has no other numbers; true and false are ints to Python.
    if type(value) not in (int, float) or not math.isfinite(value):
        raise InvalidValueError(f"{name} = {value!r}", expected="a finite number")
    return float(value)


def read_value(value: Any) -> float | tuple[float, ...] | None:
    """Read the value of an action: nothing, a number, or several.

    Raises
    ------
    InvalidValueError
        It is something else, or a number is not finite.
    """
    if value is None:
        return None
    if isinstance(value, list):
        return tuple(_number(one, "value") for one in value)
    return _number(value, "value")


def _pair(value: Any, name: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InvalidValueError(f"{name} = {value!r}", expected="two numbers")
    return _number(value[0], name), _number(value[1], name)


def read_page_request(message: dict[str, Any], before: PageRequest) -> PageRequest:
    """Read what a page wants; what the message leaves out stays as before.

    Raises
    ------
    InvalidValueError
        A value is of another kind or out of its range.
    """
    request = before
    if "pictures" in message:
        named = message["pictures"]
        if not isinstance(named, list) or not all(name in PICTURES for name in named):
            raise InvalidValueError(f"pictures = {named!r}", expected=" or ".join(PICTURES))
        request = replace(request, pictures=tuple(name for name in PICTURES if name in named))
    if "width" in message:
        width = _number(message["width"], "width")
        request = replace(request, width_px=int(min(max(width, 16.0), _LARGEST_WIDTH_PX)))
    if "contrast" in message:
        given = message["contrast"]
        if not isinstance(given, dict):
            raise InvalidValueError(f"contrast = {given!r}", expected="mode, low and high")
        mode = str(given.get("mode", "auto"))
        contrast = Contrast(mode)
        if mode == "fixed":
            low, high = (_number(given.get(name), name) for name in ("low", "high"))
            contrast = Contrast(mode, low, high)
        request = replace(request, contrast=contrast)
    if "zoom" in message:
        request = replace(request, zoom=_number(message["zoom"], "zoom"))
    if "centre" in message:
        request = replace(request, centre=_pair(message["centre"], "centre"))
    return request


def _pack(header: dict[str, object], blobs: list[bytes]) -> bytes:
    """Length of the header, header as JSON, then the pictures one after the other."""
    text = json.dumps(header, allow_nan=False).encode()
    return b"".join([struct.pack("<I", len(text)), text, *blobs])


def _scale(view: View, width_px: int) -> dict[str, object] | None:
    if view.camera is None:
        return None
    scale = pixel_scale(view.camera)
    bar = choose_scale_bar(width_px, scale.size_m, scale.sigma_m)
    return {
        "nm_per_px": 1e9 * scale.size_m,
        "pixel_size": bar.pixel_size,
        "bar_px": bar.length_px,
        "bar_label": bar.label,
        "calibrated": view.calibrated,
    }


def encode_view(view: View, request: PageRequest, *, age_s: float | None = None) -> bytes:
    """Encode a frame as one message: a header in JSON, and its pictures as JPEG.

    All pictures are stretched by the levels of the first one, so that they can be compared.

    Parameters
    ----------
    view, request
        What there is, and what the page wants of it.
    age_s
        Time since the stamp, where both are of one clock.
    """
    levels: Levels | None = None
    pictures, blobs = [], []
    # By the raw picture, also where it is not shown: the levels must not jump as the page blinks.
    for name in PICTURES:
        if (image := view.pictures.get(name)) is None:
            continue
        if levels is None:
            levels = choose_levels(image, request.contrast)
        if name not in request.pictures:
            continue
        height, width = image.shape[:2]
        region = choose_region((width, height), request.zoom, request.centre)
        data, shown = encode_picture(image, levels, region, request.width_px)
        blobs.append(data)
        pictures.append(
            {
                "name": name,
                "size": [width, height],
                "region": _corners(region),
                "shown": list(shown),
                "bytes": len(data),
                "scale": _scale(view, region.width),
            }
        )
    header: dict[str, object] = {
        "type": "view",
        "number": view.number,
        "name": view.name,
        "stamp_s": view.stamp_ns * 1e-9,
        "age_ms": None if age_s is None else round(1e3 * age_s, 1),
        "drift_px": None if view.drift_px is None else [round(v, 3) for v in view.drift_px],
        "moving": view.moving,
        "levels": None
        if levels is None
        else [levels.low, levels.high, levels.least, levels.greatest],
        "available": [name for name in PICTURES if name in view.pictures],
        "pictures": pictures,
    }
    return _pack(header, blobs)


def _corners(region: Region) -> list[int]:
    return [region.x, region.y, region.width, region.height]


def encode_overlay(number: int, image: Any, width_px: int) -> bytes:
    """Encode the picture with the corners of the grid, as :func:`encode_view` does."""
    height, width = image.shape[:2]
    region = Region(0, 0, width, height)
    data, shown = encode_picture(image, Levels(0.0, 255.0, 0.0, 255.0), region, width_px)
    header: dict[str, object] = {"type": "overlay", "number": number, "shown": list(shown)}
    return _pack(header, [data])


def describe_distance(distance: Distance, *, calibrated: bool) -> dict[str, object]:
    """Describe a length in words, with its uncertainty and where that comes from.

    Parameters
    ----------
    distance
        As measured.
    calibrated
        Whether its scale is of a calibration; otherwise it is that of a display width.
    """
    sigma_m = distance.sigma_m
    text = format_with_sigma(distance.length_m, sigma_m)
    placing = format_length(distance.placing_sigma_m, 2)
    if distance.calibration_sigma_m is None:
        why = f"the scale is nominal, so its uncertainty is not known; placing the ends: {placing}"
    else:
        scale = format_length(distance.calibration_sigma_m, 2)
        cause = "calibration" if calibrated else "nominal scale, not calibrated"
        why = f"1-sigma; {cause}: {scale}, placing the ends on the screen: {placing}"
    return {
        "text": text,
        "why": why,
        "x": _coordinate(distance.x_m, sigma_m),
        "y": _coordinate(distance.y_m, sigma_m),
        "length_nm": 1e9 * distance.length_m,
        "sigma_nm": None if sigma_m is None else 1e9 * sigma_m,
        "angle_deg": math.degrees(math.atan2(distance.y_m, distance.x_m)),
    }


def _coordinate(value_m: float, sigma_m: float | None) -> str:
    return f"{1e6 * value_m:.{digits_of(0.0 if sigma_m is None else 1e6 * sigma_m)}f}"


def measure(view: View | None, message: dict[str, Any]) -> dict[str, object]:
    """Answer what a page measures: ``picture``, ``start``, ``end``, ``placed_to``; px of the image.

    Raises
    ------
    InvalidValueError
        Something is missing, or cannot be measured.
    """
    if view is None or view.camera is None:
        raise InvalidValueError(
            "no picture with a known magnification",
            expected="one to measure in",
            do="check that the magnification is published",
        )
    picture = str(message.get("picture"))
    image = view.pictures.get(picture)
    if image is None:
        raise InvalidValueError(f"a picture {picture!r}", expected=" or ".join(view.pictures))
    height, width = image.shape[:2]
    camera = view.camera.resized(width, height)
    start = message.get("start")
    # Coordinates count from the middle: the optical axis, where the sem frame begins, is known far worse.
    begin = (0.5 * (width - 1), 0.5 * (height - 1)) if start is None else _pair(start, "start")
    distance = measure_distance(
        camera,
        picture,
        begin,
        _pair(message.get("end"), "end"),
        placed_to_px=_number(message.get("placed_to", 1.0), "placed_to"),
    )
    return describe_distance(distance, calibrated=view.calibrated)


class PageServer:
    """Serves the page in a thread of its own.

    Parameters
    ----------
    source
        What is shown.
    host, port
        Where to listen; port 0 takes a free one. For another host than :data:`LOCAL_HOSTS`, whoever comes must bring
        the token.
    token
        The token; made up where there is none.

    Raises
    ------
    InvalidValueError
        The address cannot be used.
    """

    def __init__(
        self, source: ViewSource, host: str = "localhost", port: int = 0, token: str = ""
    ) -> None:
        self.source = source
        self.local = host in LOCAL_HOSTS
        self.token = "" if self.local else token or secrets.token_urlsafe(16)
        self._sockets = _listen(host, port)
        self.port = int(self._sockets[0].getsockname()[1])
        self._host = host
        self._pages: set[_Live] = set()
        # One picture at a time: pages must not take a second core from the stream.
        self.pictures = ThreadPoolExecutor(1, "view-pictures")
        self.actions = ThreadPoolExecutor(2, "view-actions")
        self._encoding_s = 0.0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ended: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._run, name="view-server", daemon=True)
        self._ready = threading.Event()
        # Every request of a page that is open all day would be a line.
        logging.getLogger("tornado.access").setLevel(logging.ERROR)

    @property
    def address(self) -> str:
        """What to open in the browser."""
        host = self._host
        if host in ("0.0.0.0", "::", ""):
            host = socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        self._ready.wait()

    def stop(self) -> None:
        """Close all pages and end; calling it again does nothing."""
        loop, ended = self._loop, self._ended
        if self._thread.is_alive() and loop is not None and ended is not None:
            loop.call_soon_threadsafe(ended.set)
            self._thread.join()
        for sock in self._sockets:
            sock.close()
        self.pictures.shutdown(cancel_futures=True)
        # An action may be waiting for an answer that takes minutes.
        self.actions.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        arguments = {"server": self}
        application = web.Application(
            [
                (r"/", _Index, arguments),
                (r"/live", _Live, arguments),
                (r"/snapshot", _Snapshot, arguments),
                (r"/(app\.js|style\.css|icon\.svg)", _Static, {**arguments, "path": str(_PAGE)}),
            ],
            websocket_max_message_size=_LARGEST_MESSAGE,
        )
        server = httpserver.HTTPServer(application)
        server.add_sockets(self._sockets)
        self._ready.set()
        await self._ended.wait()
        server.stop()
        for page in list(self._pages):
            page.close(1001, "the viewer has ended")
        await server.close_all_connections()

    # -- what the handlers ask ---------------------------------------------------------------------

    def admits(self, handler: web.RequestHandler) -> bool:
        """Return whether a request may come in."""
        if self.local:
            # Otherwise a page of a stranger whose name leads to this computer could look in.
            name = (handler.request.host_name or "").strip("[]")
            return name in LOCAL_HOSTS
        cookie = handler.get_cookie(self.cookie) or ""
        given = handler.get_query_argument("token", "") or cookie
        return hmac.compare_digest(given.encode(), self.token.encode())

    @property
    def cookie(self) -> str:
        """Name of the cookie that holds the token; cookies are shared by all ports of a host."""
        return f"semcal_view_{self.port}"

    @property
    def picture_interval_s(self) -> float:
        """Time between two pictures of a page, s."""
        return min(max(_PICTURE_INTERVAL_S, self._encoding_s / _PICTURE_SHARE), _LONGEST_INTERVAL_S)

    def note_encoding(self, seconds: float) -> None:
        """Take note of how long a picture has taken, the wait for the processor included."""
        # Of the last few: one that was held up by chance must not count for seconds.
        self._encoding_s += 0.25 * (seconds - self._encoding_s)

    def open_page(self, page: _Live) -> None:
        """Take note of a page."""
        self._pages.add(page)
        self.source.watch(len(self._pages))

    def close_page(self, page: _Live) -> None:
        """Forget a page."""
        if page in self._pages:
            self._pages.remove(page)
            self.source.watch(len(self._pages))


def refuse_taken_port(port: int, host: str = "localhost") -> None:
    """Refuse what a :class:`PageServer` could not listen on, before any work is done for its page.

    Raises
    ------
    InvalidValueError
        The address cannot be used.
    """
    for one in _listen(host, port):
        one.close()


def _listen(host: str, port: int) -> list[socket.socket]:
    try:
        return _open_sockets(host, port)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InvalidValueError(
            f"cannot listen on {host}:{port}: {reason}",
            expected="an address of this computer and a free port",
            do="give others by --host and --port; --port 0 takes a free one",
        ) from error


def _open_sockets(host: str, port: int) -> list[socket.socket]:
    """Listen on all addresses of a host, at the same port."""
    # tornado's own function leaves sockets open where one of the addresses is taken.
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    sockets: list[socket.socket] = []
    failed: OSError | None = None
    for family, _, _, _, address in dict.fromkeys(found):
        if sockets:
            address = (address[0], sockets[0].getsockname()[1], *address[2:])
        try:
            made = socket.create_server(address, family=family, backlog=128)
        except OSError as error:
            # A computer may know an address of IPv6 and not have it; a port that is taken counts for all.
            if error.errno == errno.EADDRINUSE:
                for one in sockets:
                    one.close()
                raise
            failed = error
            continue
        made.setblocking(False)
        sockets.append(made)
    if not sockets:
        raise failed or OSError(f"no address of {host}")
    return sockets


class _Guarded(web.RequestHandler):
    """Answers only those who may come in."""

    def initialize(self, server: PageServer) -> None:
        self._server = server

    def prepare(self) -> None:
        if not self._server.admits(self):
            if self._server.local:
                self.set_status(403)
                self.finish("This page is for users of this computer; open it as localhost.\n")
            else:
                self.set_status(401)
                self.finish(
                    "Open this page with the token that `semcal view` has printed: /?token=...\n"
                )

    def set_default_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.set_header(name, value)

    def write_error(self, status_code: int, **_: Any) -> None:
        self.finish(f"{status_code}: {self._reason}\n")


class _Index(_Guarded):
    def get(self) -> None:
        if self._server.token and self.get_query_argument("token", ""):
            # So that the token does not stay in the address and in the browser's history.
            self.set_cookie(
                self._server.cookie, self._server.token, httponly=True, samesite="Strict"
            )
            self.redirect("/")
            return
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish((_PAGE / "index.html").read_bytes())


class _Static(_Guarded, web.StaticFileHandler):
    def initialize(self, server: PageServer, path: str) -> None:  # type: ignore[override]
        _Guarded.initialize(self, server)
        web.StaticFileHandler.initialize(self, path)


class _Snapshot(_Guarded):
    async def get(self) -> None:
        """The picture that is shown now as TIFF, in the grey levels of the detector."""
        view = self._server.source.newest()
        name = self.get_query_argument("picture", "corrected")
        if view is None or name not in view.pictures:
            self.set_status(404)
            self.finish(f"There is no picture {name!r} yet.\n")
            return
        loop = asyncio.get_running_loop()
        data = await loop.run_in_executor(self._server.pictures, make_snapshot, view, name)
        self.set_header("Content-Type", "image/tiff")
        self.set_header(
            "Content-Disposition", f'attachment; filename="{name_snapshot(view, name)}"'
        )
        self.finish(data)


def name_snapshot(view: View, picture: str) -> str:
    """Name the file of a snapshot after picture, magnification and time."""
    g = "" if view.camera is None else f"_{view.camera.magnification:.6g}x"
    when = datetime.fromtimestamp(view.stamp_ns * 1e-9, timezone.utc)
    return f"{picture}{g}_{when:%Y%m%dT%H%M%S_%f}.tif"


def make_snapshot(view: View, picture: str) -> bytes:
    """Make an OME-TIFF of a picture, with its pixel size, time, and what else is known."""
    image: NDArray[Any] = view.pictures[picture]
    if image.ndim == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    notes: dict[str, object] = {"picture": picture, **view.notes}
    if view.name:
        notes["name"] = view.name
    if view.camera is None:
        # A file needs some pixel size; one metre is certainly not that of an SEM.
        scale = PixelScale(1.0)
        notes["scale"] = "unknown: the magnification was not known"
    else:
        scale = pixel_scale(view.camera)
        notes["magnification"] = view.camera.magnification
        notes["scale"] = "calibrated" if view.calibrated else "nominal"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "snapshot.tif"
        write_image(path, image, scale, stamp_ns=view.stamp_ns, notes=notes)
        return path.read_bytes()


class _Live(websocket.WebSocketHandler):
    """One open page."""

    def initialize(self, server: PageServer) -> None:
        self._server = server
        self._request = PageRequest()
        self._changed = True
        self._sent = self._overlay = -1
        self._waits_since_s: float | None = None
        self._feeder: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def prepare(self) -> None:
        if not self._server.admits(self):
            self.set_status(403)
            self.finish()

    def open(self, *_: str, **__: str) -> None:
        self.set_nodelay(True)
        self._server.open_page(self)
        self._feeder = asyncio.create_task(self._feed())

    def on_close(self) -> None:
        self._server.close_page(self)
        if self._feeder is not None:
            self._feeder.cancel()

    # -- to the page -------------------------------------------------------------------------------

    async def _feed(self) -> None:
        status_s = picture_s = 0.0
        try:
            while True:
                now_s = time.monotonic()
                if now_s - status_s >= _STATUS_INTERVAL_S:
                    status_s = now_s
                    await self._send_status()
                if now_s - picture_s >= self._server.picture_interval_s and self._may_send(now_s):
                    picture_s = now_s
                    await self._send_picture()
                await asyncio.sleep(_POLL_S)
        except websocket.WebSocketClosedError:
            pass
        except Exception:
            # The page would stay as it is and say nothing; closed, it says so, and asks again.
            logging.getLogger(__name__).exception("the page could not be fed")
            self.close()

    def _may_send(self, now_s: float) -> bool:
        """Whether the page has shown the picture before; otherwise this one is left out."""
        return self._waits_since_s is None or now_s - self._waits_since_s > _PATIENCE_S

    async def _send_status(self) -> None:
        status = self._server.source.describe()
        await self.write_message(json.dumps({"type": "status", **asdict(status)}))
        panel = status.calibration
        if panel is not None and panel.overlay and panel.overlay != self._overlay:
            image = self._server.source.overlay()
            if image is not None:
                self._overlay = panel.overlay
                data = await self._in_background(encode_overlay, panel.overlay, image, 720)
                await self.write_message(data, binary=True)

    async def _send_picture(self) -> None:
        view = self._server.source.newest()
        if view is None or (view.number == self._sent and not self._changed):
            return
        self._changed, self._sent = False, view.number
        age_s: float | None = time.time() - view.stamp_ns * 1e-9
        if age_s is not None and abs(age_s) > _OTHER_CLOCK_S:
            age_s = None
        started_s = time.monotonic()
        data = await self._in_background(encode_view, view, self._request, age_s=age_s)
        self._server.note_encoding(time.monotonic() - started_s)
        self._waits_since_s = time.monotonic()
        await self.write_message(data, binary=True)

    async def _in_background(self, function: Any, *arguments: Any, **named: Any) -> bytes:
        loop = asyncio.get_running_loop()
        data: bytes = await loop.run_in_executor(
            self._server.pictures, lambda: function(*arguments, **named)
        )
        return data

    # -- from the page -----------------------------------------------------------------------------

    def on_message(self, message: str | bytes) -> None:
        """Extend the base class: what the page asks is answered, never raised."""
        try:
            request = json.loads(message)
            if not isinstance(request, dict):
                raise InvalidValueError("a message that is no object", expected="a JSON object")
            self._answer(request)
        except (SemcalError, ValueError, RecursionError) as error:
            self._tell({"type": "refused", "text": " ".join(str(error).split())})

    def _tell(self, answer: dict[str, object]) -> None:
        # The page may have been closed meanwhile.
        if self.ws_connection is not None and not self.ws_connection.is_closing():
            self.write_message(json.dumps(answer))

    def _answer(self, request: dict[str, Any]) -> None:
        kind = request.get("type")
        if kind == "seen":
            self._waits_since_s = None
        elif kind == "request":
            self._request = read_page_request(request, self._request)
            self._changed = True
        elif kind == "measure":
            view = self._server.source.newest()
            self._tell(
                {"type": "measured", "of": str(request.get("of", "")), **measure(view, request)}
            )
        elif kind == "act" and request.get("action") in ACTIONS:
            task = asyncio.create_task(
                self._act(request["action"], read_value(request.get("value")))
            )
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        else:
            raise InvalidValueError(
                f"a message of type {kind!r}", expected="seen, request, measure or act"
            )

    async def _act(self, action: str, value: float | tuple[float, ...] | None) -> None:
        loop = asyncio.get_running_loop()
        try:
            text = await loop.run_in_executor(
                self._server.actions, self._server.source.act, action, value
            )
            done = True
        except SemcalError as error:
            text, done = " ".join(str(error).split()), False
        self._changed = True
        if action != "seek" or not done:
            self._tell({"type": "done", "action": action, "success": done, "text": text})
