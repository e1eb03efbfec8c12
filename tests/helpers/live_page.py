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

"""``semcal view`` as a user starts it, and what a page hears of it."""

from __future__ import annotations

import asyncio
import json
import os
import re
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tornado.websocket import websocket_connect

from tests.helpers.project import ROOT

START_S = 60.0
PICTURE_S = 60.0


@contextmanager
def viewing(*arguments: str) -> Iterator[str]:
    """``semcal view`` as a user starts it; the address that it prints."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        [sys.executable, "-m", "semcal_ros", "view", "--port", "0", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
        env=environment,
    ) as process:
        try:
            assert process.stdout is not None
            said = ""
            deadline = time.monotonic() + START_S
            while not (found := re.search(r"open (http://\S+?)(;|\s|$)", said)):
                line = process.stdout.readline()
                assert line and time.monotonic() < deadline, said
                said += line
            yield found[1]
        finally:
            process.terminate()
            process.wait(30)
        assert process.returncode == 0


def corrected_view(address: str) -> dict[str, Any]:
    """What the page is told of the first frame that came raw and corrected, with a calibrated scale."""
    return asyncio.run(asyncio.wait_for(_corrected_view(address), PICTURE_S))


async def _corrected_view(address: str) -> dict[str, Any]:
    page = await websocket_connect(f"{address.replace('http', 'ws', 1)}live")
    try:
        while True:
            told = await page.read_message()
            assert told is not None
            if isinstance(told, str):
                continue
            await page.write_message(json.dumps({"type": "seen"}))
            (length,) = struct.unpack_from("<I", told)
            header: dict[str, Any] = json.loads(told[4 : 4 + length])
            pictures = {picture["name"]: picture["scale"] for picture in header["pictures"]}
            # At first one of the two may not have been subscribed yet.
            if set(pictures) == {"raw", "corrected"}:
                scale = pictures["corrected"]
                if scale and "±" in scale["bar_label"]:
                    return header
    finally:
        page.close()
        while await page.read_message() is not None:
            pass
