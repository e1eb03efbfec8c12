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

"""The pages in a real browser: no console errors, and nothing wider than the window."""

from __future__ import annotations

import html
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from examples.demo.correction_page import DemoRow, write_correction_report
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.report.calibration.numbers import tabulate_cameras
from semcal_ros.report.html.page import format_length, render
from tests.helpers.chromium import chromium

BROWSER = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)
# A window of the browser cannot be as narrow as a telephone, but a frame in it can. The pages
# forbid scripts of their own, so the surrounding page looks into them, with all that folds unfolded.
FRAME = """<!DOCTYPE html>
{frames}
<script>addEventListener('load', () => {{
  document.body.dataset.probe = [...document.querySelectorAll('iframe')].map(frame => {{
    const inside = frame.contentDocument, root = inside.documentElement;
    inside.querySelectorAll('details').forEach(d => {{ d.open = true; }});
    const pictures = [...inside.images];
    const wide = [...pictures, ...inside.querySelectorAll('svg, p, h1, h2, h3, dl, nav')]
      .filter(e => e.getBoundingClientRect().right > root.clientWidth + 0.5);
    const words = [...inside.querySelectorAll('p, td, th, figcaption, li, dt, dd, a')]
      .filter(e => e.textContent.trim() && parseFloat(frame.contentWindow.getComputedStyle(e).fontSize) < 12);
    return [root.clientWidth, root.scrollWidth, pictures.length,
      pictures.filter(i => i.naturalWidth > 0).length, wide.length, words.length].join(' ');
  }}).join(',');
}})</script>"""
WIDTHS = (1280, 390)


def opened(path: Path, profile: Path) -> tuple[str, str]:
    """The page's DOM after loading and what the browser logged."""
    assert BROWSER is not None
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    # Without any network: every host name is unknown.
    options += ["--host-resolver-rules=MAP * ~NOTFOUND"]
    options += ["--enable-logging=stderr", "--v=0", f"--user-data-dir={profile}"]
    command = [BROWSER, *options, "--window-size=1400,900", "--dump-dom", path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout, done.stderr


def long_words_text() -> str:
    """The calibration page with long words everywhere, without the time that its figures take."""
    long_word = "frame_" + "0123456789" * 12
    row = {"label": long_word, "here": "0.050 px", "paper": "1.45 px (median, section 4.1.3)"}
    view = {
        **dict.fromkeys(("src", "dots", "arrows", "alt"), ""),
        "name": long_word,
        "magnification": "100×",
        "corners": 1,
        "rms": "0.1 px",
        "ratio": 1.0,
        "facts": [(long_word, long_word)],
        "caption": long_word,
        "width": 480,
        "height": 480,
        "marks": [{"path": "M1 1l2 2", "text": "0.1 px"}],
        "bar": {"path": "M380 460h90", "x": 470, "y": 450, "label": long_word, "type_px": 12},
    }
    return render(
        "calibration.html.j2",
        {
            "title": long_word,
            "summary": [("Held-out error", "0.050 px", "RMS of images left out")] * 6,
            "cameras": [
                {"title": long_word, "values": [(long_word, long_word)], "K": [[long_word]]}
            ],
            "slider": "",
            "verdict": [long_word],
            "commands": [(long_word, f"semcal plan {long_word}.yaml --target 0.1%")],
            "warnings": [long_word],
            "paper": [row],
            "worst_views": [view],
            **dict.fromkeys(
                ("coverage", "errors", "residuals", "pixel_size", "distortion", "parameters"), ()
            ),
            **dict.fromkeys(("overlays", "more_overlays", "rejected_images"), ()),
            **dict.fromkeys(("predicted", "residual_field", "rows", "images"), ()),
            "refused_corners": 0,
            "blink": None,
            "rejected": [(long_word, "100×", long_word)],
            "rejected_count": 1,
            "facts": [("Priors", long_word)],
        },
    )


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize(
    "kind",
    [pytest.param("calibration", marks=pytest.mark.slow), "long words", "correction"],
)
def test_page_fits_the_window_without_console_errors(
    tmp_path: Path, kind: str, request: pytest.FixtureRequest
) -> None:
    if kind == "long words":
        text = long_words_text()
        pictures = 0
    elif kind == "calibration":
        text = request.getfixturevalue("page_path").read_text(encoding="utf-8")
        pictures = text.count("<img ")
        assert pictures > 20
    else:
        rows = [DemoRow("with drift and distortion correction", 0.11, (0.9, 1.45))]
        page = write_correction_report(
            rows, [("after", np.zeros((600, 640), np.uint8))], tmp_path / "page.html"
        )
        text = page.read_text(encoding="utf-8")
        pictures = 2
    frames = "\n".join(
        f'<iframe width="{width}" height="900" style="border:0" srcdoc="{html.escape(text)}"></iframe>'
        for width in WIDTHS
    )
    frame = tmp_path / "frame.html"
    frame.write_text(FRAME.format(frames=frames), encoding="utf-8")
    dom, log = opened(frame, tmp_path / "profile")
    assert "CONSOLE" not in log
    match = re.search(r'data-probe="([\d ,]+)"', dom)
    assert match is not None
    for width, probe in zip(WIDTHS, match[1].split(","), strict=True):
        inner, scroll, found, loaded, wide, small = (int(x) for x in probe.split())
        assert inner == width
        assert scroll <= inner
        assert found == loaded == pictures
        assert wide == 0
        assert small == 0


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_the_slider_shows_the_camera_of_its_magnification_and_raw_and_corrected_blink(
    page_path: Path, result: CalibrationResult, tmp_path: Path
) -> None:
    rows = tabulate_cameras(result.model)
    with chromium(tmp_path / "profile") as page:
        page.open(page_path.as_uri())
        page.wait_for("!document.querySelector('#magnification-slider').hidden")
        for k in (0, len(rows) // 3, len(rows) - 1):
            page.evaluate(
                "(() => { const s = document.querySelector('#magnification-slider');"
                f" s.value = {k}; s.dispatchEvent(new Event('input')); }})()"
            )
            assert page.text("#magnification-shown").startswith(rows[k]["title"])
            camera = result.model.at(rows[k]["g"])
            assert page.text("#camera-k-0-0") == f"{camera.K[0, 0]:.6g}"
            assert page.text("#camera-value-0") == format_length(
                camera.pixel_size_m[0], camera.pixel_size_sigma_m[0]
            )
        # Raw first, then the corrected picture at the same place, without a script.
        visible = "getComputedStyle(document.querySelector('.blink .corrected')).visibility"
        assert page.evaluate(visible) == "hidden"
        page.click("label[for=blink-corrected]")
        page.wait_for(f"{visible} === 'visible'")
        page.click("label[for=blink-both]")
        page.wait_for(f"{visible} === 'hidden'")
        page.wait_for(f"{visible} === 'visible'")
        assert page.console == []


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_the_browser_would_report_a_broken_page(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text("<!DOCTYPE html><img src='https://example.invalid/a.png'><script>x.y</script>")
    assert "CONSOLE" in opened(page, tmp_path / "profile")[1]
