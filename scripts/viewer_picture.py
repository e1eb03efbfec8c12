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

"""Takes the pictures of the live page that README.md and doc/viewers.md show: `semcal demo` in a headless Chromium.

Needs Chromium; ``python scripts/viewer_picture.py``.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.helpers.chromium import chromium  # noqa: E402  # the browser as the tests drive it

OUTPUTS = {
    1280: ROOT / "doc" / "images" / "viewer.webp",
    390: ROOT / "doc" / "images" / "viewer_narrow.webp",
}
HEIGHT = 720
# Until the drift is known to less than a pixel.
SETTLED_S = 12.0


def main() -> None:
    """Write both pictures."""
    command = [sys.executable, "-u", "-m", "semcal_ros", "demo", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as demo:
        assert demo.stdout is not None
        found = None
        while found is None:
            found = re.search(r"open (http://\S+/)", demo.stdout.readline())
        with tempfile.TemporaryDirectory() as profile, chromium(Path(profile)) as page:
            for width, output in OUTPUTS.items():
                page.size(width, HEIGHT)
                page.open(found[1])
                page.wait_for(
                    "document.querySelector('#range').textContent.startsWith('calibrated')"
                )
                page.wait_for("document.querySelector('#drift-text').textContent.includes('±')")
                time.sleep(SETTLED_S)
                shot = Path(profile) / "page.png"
                page.screenshot(shot)
                with Image.open(shot) as image:
                    image.convert("RGB").save(output, quality=80, method=6)
                print(output, output.stat().st_size)
        demo.send_signal(signal.SIGINT)


if __name__ == "__main__":
    main()
