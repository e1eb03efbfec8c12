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

"""``semcal view`` in a real browser, with the nodes behind it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tifffile
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import Image

from semcal_ros.bridge.diagnostics import join_states
from tests.helpers.chromium import BROWSER, Page, chromium
from tests.helpers.live_page import viewing
from tests.helpers.node_scenes import write_recording
from tests.helpers.project import ROOT
from tests.helpers.ros_process import Peer, running

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed"),
]
SIZE = 96
SEM = {
    "specimen": "gold",
    "drift": "fast",
    "magnification": 4000.0,
    "rate": 10.0,
    "width": SIZE,
    "height": SIZE,
    "bits": 16,
}


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with chromium(tmp_path / "profile") as made:
        yield made


def wait_bright(page: Page, picture: str) -> None:
    """Wait until the canvas of a picture shows one: its grey levels have a standard deviation of more than 30.

    A picture of gold uses the whole range; an empty canvas is 0.
    """
    page.wait_for(
        f"(() => {{ const c = document.querySelector('figure[data-picture={picture}] canvas');"
        # A copy to read from: the browser warns of a canvas that is drawn to and read again and again.
        " const copy = document.createElement('canvas'); copy.width = c.width; copy.height = c.height;"
        " const pen = copy.getContext('2d', {willReadFrequently: true}); pen.drawImage(c, 0, 0);"
        " const d = pen.getImageData(0, 0, c.width, c.height).data; let s = 0, q = 0, n = 0;"
        " for (let i = 0; i < d.length; i += 4) { s += d[i]; q += d[i] * d[i]; n += 1; }"
        " return Math.sqrt(q / n - (s / n) ** 2) > 30; })()"
    )


def press(page: Page, action: str) -> None:
    """Press a button once somebody offers what it does."""
    page.wait_for(f"!document.querySelector('[data-action={action}]').disabled")
    page.click(f"[data-action={action}]")


def fits(page: Page) -> None:
    """Nothing is wider than the window, and no text is smaller than 12 px."""
    wide, small = page.evaluate(
        "[document.documentElement.scrollWidth - innerWidth,"
        " [...document.querySelectorAll('body *')].filter(e => e.textContent.trim() &&"
        " parseFloat(getComputedStyle(e).fontSize) < 12).length]"
    )
    assert (wide, small) == (0, 0)


def hover(page: Page, picture: str, fraction: float) -> None:
    """Move the mouse over a picture, to a part of its width at half of its height."""
    x, y, w, h = page.box(f"figure[data-picture={picture}] canvas")
    page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + fraction * w, y=y + 0.5 * h)


def wait_cursor(page: Page, picture: str, fraction: float, expected_um: float) -> None:
    """Wait until the cursor there has an x, um: a picture of what was asked for may be on its way."""
    deadline, found = time.monotonic() + 20.0, None
    while found is None or abs(float(found[1]) - expected_um) > 0.7:
        assert time.monotonic() < deadline, page.text("#cursor")
        hover(page, picture, fraction)
        time.sleep(0.1)
        form = r"x (-?[\d.]+), y -?[\d.]+ µm from the middle, ± [\d.]+"
        found = re.fullmatch(form, page.text("#cursor"))


def look_closer(page: Page, folder: Path) -> None:
    """What is done with one picture: contrast, cursor, zoom, Move, and a file of it."""
    folder.mkdir(exist_ok=True)
    # Grey levels of 16 bit, of which the darkest and brightest half per cent are lost.
    low, high, most = (float(number) for number in re.findall(r"[\d.]+", page.text("#levels")))
    assert most == 65535 and 0 <= low < high <= most
    page.evaluate(
        "(() => { const s = document.querySelector('#contrast'); s.value = 'full';"
        " s.dispatchEvent(new Event('change')); })()"
    )
    page.wait_for("document.querySelector('#levels').textContent === '0 to 65535 of 65535'")
    # A field of 0.12 m / 4000 = 30 um; a pixel is 0.3 um.
    wait_cursor(page, "corrected", 0.75, 7.5)
    wait_cursor(page, "corrected", 0.5, 0.0)
    for _ in range(2):
        page.click("#zoom-in")
    page.click("[data-tool=move]")
    x, y, w, h = page.box("figure[data-picture=corrected] canvas")
    # Dragged to the right by a quarter of what is shown, 30 / 2.25 um: the middle now shows what was left of it.
    page.drag([(x + f * w, y + 0.5 * h) for f in (0.5, 0.6, 0.75)])
    wait_cursor(page, "corrected", 0.5, -30 / 2.25 / 4)
    page.click("[data-tool=ruler]")
    page.click("#zoom-all")
    with tifffile.TiffFile(page.download("#snap-corrected", folder)) as file:
        assert file.asarray().dtype == np.uint16 and file.asarray().shape == (SIZE, SIZE)
        told = file.ome_metadata or ""
    assert "PhysicalSizeX" in told and "drift_x_m" in told and "calibrated" in told


@pytest.mark.long
def test_the_live_page(peer: Peer, page: Page, calibration_file: Path, tmp_path: Path) -> None:
    raw = peer.node.get_publishers_info_by_topic
    with (
        running("virtual_sem", SEM),
        running("stream_corrector", {"calibration": calibration_file}),
        viewing("--calibration", str(calibration_file)) as address,
    ):
        peer.wait_for(lambda: raw("/sem/image_rect"), "the corrector")

        def watched() -> int:
            return sum(
                one.node_name == "viewer"
                for one in peer.node.get_subscriptions_info_by_topic("/sem/image_raw")
            )

        peer.wait_for(lambda: raw("/sem/image_raw"), "the microscope")
        assert watched() == 0
        for width in (1280, 390):
            page.size(width, 844)
            page.open(address)
            page.wait_for(
                "!document.querySelector('#snap-corrected').hasAttribute('aria-disabled')"
            )
            page.wait_for("document.querySelector('#magnification').textContent === '4000×'")
            page.wait_for("document.querySelector('#range').textContent.startsWith('calibrated')")
            # The first pictures may come before their magnification.
            page.wait_for("document.querySelector('#pixel').textContent.includes('±')")
            for picture in ("raw", "corrected"):
                wait_bright(page, picture)
            peer.wait_for(lambda: watched() == 1, "the subscription")
            page.wait_for("document.querySelector('#drift-text').textContent.includes('±')")
            page.wait_for(
                "document.querySelector('#rates').textContent.includes('stream_corrector')"
            )
            fits(page)

            x, y, w, h = page.box("figure[data-picture=corrected] canvas")
            page.drag([(x + f * w, y + 0.5 * h) for f in (0.25, 0.5, 0.75)])
            # While the mouse moves, shorter ways are measured.
            page.wait_for("parseFloat(document.querySelector('#ruler').textContent) > 10")
            found = re.match(r"([\d.]+) ± ([\d.]+) µm", page.text("#ruler"))
            assert found is not None
            # Half of the field of view of 0.12 m / 4000 on the nominal scale, which this calibration
            # changes by a per cent or two; an end is placed to a pixel of the screen.
            assert float(found[1]) == pytest.approx(15.0, rel=0.05)
            assert "calibration" in page.text("#why")
            if width == 1280:
                look_closer(page, tmp_path / "files")

            press(page, "reset")
            page.wait_for("document.querySelector('#answer').className === 'ok'")
            press(page, "stop")
            page.wait_for("document.querySelector('#answer').textContent.includes('stop')")
            images = peer.collect(Image, "image_raw")
            peer.spin(1.0)
            count = len(images)
            peer.spin(1.0)
            assert len(images) == count
            page.wait_for(
                "/virtual_sem is stopped/.test(document.querySelector('#notes').textContent)"
            )
            press(page, "start")
            peer.wait_for(lambda n=count, i=images: len(i) > n, "frames again")

            page.click("[data-layout=blink]")
            for picture in ("raw", "corrected", "raw"):
                page.wait_for(
                    f"!document.querySelector('figure[data-picture={picture}]').hidden", 5.0
                )
            page.click("[data-layout=corrected]")
            page.click("#zoom-in")
            page.wait_for("document.querySelector('#zoom').textContent === '1.5×'")
            fits(page)
            page.click("#zoom-all")
        page.open("about:blank")
        peer.wait_for(lambda: watched() == 0, "the end of the subscription")
    assert page.console == []


@pytest.mark.long
def test_bad_days_and_the_end_of_the_viewer_are_told(peer: Peer, page: Page) -> None:
    """What a microscope says of itself, and that the viewer has ended; it goes on when it is back."""
    bad = join_states(["blank frames", "not moving any more: no answer; expected tilt 0.1 rad"])
    said = DiagnosticStatus(level=b"\x01", name="/sem/microscope: stream", message=bad)
    diagnostics = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    with viewing() as address:
        page.size(390, 844)
        page.open(address)
        page.wait_for("document.querySelector('#link').textContent === 'connected'")
        page.wait_for("document.querySelector('#notes').textContent.includes('no node')")

        def shown() -> bool:
            diagnostics.publish(DiagnosticArray(status=[said]))
            return bool(page.evaluate("document.querySelectorAll('#notes li').length === 2"))

        peer.wait_for(shown, "both states")
        worst, other = (page.text(f"#notes li:nth-child({k})") for k in (1, 2))
        assert worst.startswith("microscope does not move anything any more: no answer, expected")
        assert "then press Start" in worst
        assert other.startswith("microscope gets pictures without anything in them")
        assert "beam blank" in other
        fits(page)
    page.wait_for("document.querySelector('#link').className.includes('error')")
    port = address.rstrip("/").rpartition(":")[2]
    with viewing("--port", port):
        page.wait_for("document.querySelector('#link').textContent === 'connected'")


@pytest.mark.long
def test_a_port_that_is_taken_is_refused_in_one_line() -> None:
    with viewing() as address:
        port = address.rstrip("/").rpartition(":")[2]
        done = subprocess.run(
            [sys.executable, "-m", "semcal_ros", "view", "--port", port],
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            timeout=60,
            check=False,
        )
    assert done.returncode == 2
    assert "--port 0" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.long
def test_a_recording_in_the_browser(page: Page, tmp_path: Path, calibration_file: Path) -> None:
    write_recording(tmp_path / "bag", [2000.0] * 30, 0.05)
    with viewing(str(tmp_path / "bag"), "--calibration", str(calibration_file)) as address:
        for width in (1280, 390):
            page.size(width, 844)
            page.open(address)
            page.wait_for("document.querySelector('#clock').textContent.startsWith('1 of 30')")
            fits(page)
            x, y, w, h = page.box("#time")
            page.drag([(x + 0.5 * w, y + h / 2)])
            page.wait_for("/^1[456] of 30/.test(document.querySelector('#clock').textContent)")
            press(page, "play")
            page.wait_for("document.querySelector('#clock').textContent.startsWith('30 of 30')")
            assert page.evaluate("document.querySelector('#microscope').hidden")
            page.drag([(x + 1, page.box("#time")[1] + h / 2)])
    assert page.console == []


@pytest.mark.long
def test_the_calibration_panel(page: Page, tmp_path: Path) -> None:
    grid = {"specimen": "grid", "magnification": 1000.0, "rate": 5.0, "width": 320, "height": 320}
    with (
        running("virtual_sem", grid),
        running("calibration_server", {"config": "virtual_sem", "directory": tmp_path}),
        viewing() as address,
    ):
        page.size(1280, 844)
        page.open(address)
        page.wait_for("!document.querySelector('#calibration').hidden")
        for action in ("save", "check"):
            press(page, action)
            page.wait_for("document.querySelector('#answer').className === 'error'")
            page.wait_for(
                "/no calibration|no usable view/.test(document.querySelector('#answer').textContent)"
            )
        # Nobody has added a view: these are the corners of the live picture.
        page.wait_for("document.querySelector('#overlay img').naturalWidth === 320")
        page.wait_for("/^\\d+ corners$/.test(document.querySelector('#corners').textContent)")
        # A person is guided through the plan: the first view is the one that the microscope shows.
        for field, value in (("low", "1000"), ("high", "3000"), ("target", "2")):
            page.type(f"#goal-{field}", value)
        press(page, "acquire")
        page.wait_for(
            "/^Please set 1000x anew, tilt to 0/.test(document.querySelector('#request').textContent)"
        )
        assert page.evaluate("document.querySelector('#goal-high').value") == "3000"
        press(page, "add_view")
        page.wait_for(
            "/tilt to 20 degrees.*then press Add view/.test(document.querySelector('#request').textContent)"
        )
        assert "1 of 12 so far" in page.text("#acquisition-bars")
        fits(page)
        page.click("#acquisition [data-action=cancel]")
        page.wait_for("document.querySelector('[data-action=acquire]').textContent === 'Go on'")
        assert page.text("#request").startswith("stopped")
        for count in (2, 3):
            press(page, "add_view")
            page.wait_for(
                f"document.querySelector('#calibration-answer').textContent.includes('view {count} at')"
            )
        shares = page.evaluate("[...document.querySelectorAll('#bars progress')].map(p => p.value)")
        # Three views of one magnification, which the grid fills: of nine magnifications, and five views.
        assert shares[0] > 0.9
        assert shares[2:] == pytest.approx([1 / 9, 3 / 5])
        fits(page)
        page.size(390, 844)
        fits(page)
        press(page, "calibrate")
        page.wait_for("document.querySelector('#answer').textContent.includes('calibrating')")
        # Three views without tilt or rotation make no good calibration, but they make one or are refused in words.
        page.wait_for(
            "!/calibrating/.test(document.querySelector('#calibration-answer').textContent)", 60.0
        )
        press(page, "clear")
        page.wait_for("document.querySelector('#answer').textContent.includes('3 views removed')")
    assert page.console == []
