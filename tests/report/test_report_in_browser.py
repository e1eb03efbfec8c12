"""The pages in a real browser: no console errors, and nothing wider than the window."""

from __future__ import annotations

import html
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from semcal_ros.report import DemoRow, correction_report
from semcal_ros.report.page import render

BROWSER = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)
# A window of the browser cannot be as narrow as a telephone, but a frame in it can. The page
# forbids scripts of its own, so the surrounding page looks into it.
FRAME = """<!DOCTYPE html>
<iframe width="{width}" height="900" style="border:0" srcdoc="{page}"></iframe>
<script>addEventListener('load', () => {{
  const inside = document.querySelector('iframe').contentDocument;
  const root = inside.documentElement;
  document.body.dataset.probe = [root.clientWidth, root.scrollWidth,
    [...inside.images].filter(i => i.naturalWidth > 0).length].join(' ');
}})</script>"""


def opened(path: Path, profile: Path) -> tuple[str, str]:
    """The page's DOM after loading and what the browser logged."""
    assert BROWSER is not None
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    options += ["--enable-logging=stderr", "--v=0", f"--user-data-dir={profile}"]
    command = [BROWSER, *options, "--window-size=1400,900", "--dump-dom", path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout, done.stderr


def calibration_text() -> str:
    """The calibration page with long words everywhere, without the time that its figures take."""
    long_word = "frame_" + "0123456789" * 12
    return render(
        "calibration.html.j2",
        {
            "title": long_word,
            "summary": [("Held-out error", "0.050 px", "RMS; paper: 0.9 to 1.45 px")] * 6,
            "warnings": [long_word],
            "overlays": [],
            **dict.fromkeys(
                ("coverage", "errors", "residuals", "pixel_size", "distortion", "parameters"), ()
            ),
            "rejected": [(long_word, "100×", long_word)],
            "rows": [],
            "facts": [("Priors", long_word)],
            "images": [],
        },
    )


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("kind", ["calibration", "correction"])
def test_page_fits_the_window_without_console_errors(tmp_path: Path, kind: str, width: int) -> None:
    page = tmp_path / "page.html"
    pictures = 0
    if kind == "calibration":
        page.write_text(calibration_text(), encoding="utf-8")
    else:
        rows = [DemoRow("with drift and distortion correction", 0.11, (0.9, 1.45))]
        correction_report(rows, [("after", np.zeros((600, 640), np.uint8))], page)
        pictures = 2
    text = page.read_text(encoding="utf-8")
    frame = tmp_path / "frame.html"
    frame.write_text(FRAME.format(width=width, page=html.escape(text)), encoding="utf-8")
    dom, log = opened(frame, tmp_path / "profile")
    assert "CONSOLE" not in log
    match = re.search(r'data-probe="(\d+) (\d+) (\d+)"', dom)
    assert match is not None
    inner, scroll, loaded = (int(x) for x in match.groups())
    assert inner == width
    assert scroll <= inner
    assert loaded == pictures
