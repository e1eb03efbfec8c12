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

"""Make the animated picture of the README: `python scripts/readme_picture.py` writes doc/images/correction.webp.

Gold on carbon on the virtual SEM, at a magnification that was never calibrated: the frames as the microscope gives
them, the same frames corrected, and their mean so far. All three are cut to the same field, whose scale bar is that of
the corrected frames.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from semcal_ros import Calibration, calibrate, rectify
from semcal_ros.config.config import load_config
from semcal_ros.files.images.scale_bar import ScaleBar, choose_scale_bar
from semcal_ros.files.recordings import open_recording
from semcal_ros.workflows.simulate import simulate

OUTPUT = Path(__file__).resolve().parents[1] / "doc" / "images" / "correction.webp"
CALIBRATED = (100.0, 250.0, 600.0, 1200.0, 2500.0, 4000.0, 6000.0, 8000.0, 10000.0)
MAGNIFICATION, FRAMES = 5250.0, 36
# Part of the field that stays in view while the specimen drifts, px, and how much it is enlarged.
FIELD_PX, ENLARGED = 140, 2
LABELS = ("as recorded", "corrected", "mean of corrected frames")


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        simulate(base / "grid", "grid", magnifications=CALIBRATED, views=4)
        calibration = calibrate(base / "grid", config="virtual_sem")
        simulate(base / "gold", "drift", magnifications=(MAGNIFICATION,), frames=FRAMES)
        pages = draw_pages(base / "gold", calibration)
    pages[0].save(
        OUTPUT, save_all=True, append_images=pages[1:], duration=160, loop=0, quality=45, method=6
    )
    print(f"{OUTPUT}: {OUTPUT.stat().st_size / 1e3:.0f} kB")
    return 0


def draw_pages(recording: Path, calibration: Calibration) -> list[Image.Image]:
    """Draw one page for each frame."""
    corrected = rectify(recording, calibration=calibration, config="virtual_sem")
    raw = [grey for grey, _ in read_frames(recording)]
    flat = [np.asarray(image, dtype=np.float32) for image in corrected.images]
    camera = corrected.frames[0].camera.rectified
    bar = choose_scale_bar(FIELD_PX, camera.pixel_size_m[0], max(camera.pixel_size_sigma_m))
    height, width = raw[0].shape
    window = np.s_[
        (height - FIELD_PX) // 2 : (height + FIELD_PX) // 2,
        (width - FIELD_PX) // 2 : (width + FIELD_PX) // 2,
    ]
    low, high = np.percentile(flat[0][window], (0.5, 99.5))
    total = np.zeros((FIELD_PX, FIELD_PX), dtype=np.float64)
    pages = []
    for count, (as_recorded, image) in enumerate(zip(raw, flat, strict=True), start=1):
        total += image[window]
        panels = [as_recorded[window], image[window], total / count]
        pages.append(draw_page(panels, (low, high), bar, count))
    return pages


def read_frames(recording: Path) -> list[tuple[np.ndarray, float]]:
    """Read grey levels and magnification of all frames."""
    config = load_config("virtual_sem")
    with open_recording(recording, config) as opened:
        return [(np.asarray(f.image, np.float32), f.magnification) for f in opened.frames()]


def draw_page(
    panels: list[np.ndarray], levels: tuple[float, float], bar: ScaleBar, count: int
) -> Image.Image:
    """Draw the panels side by side, with labels above and the scale bar below."""
    side, gap, top, bottom = FIELD_PX * ENLARGED, 8, 26, 30
    page = Image.new("L", (3 * side + 2 * gap, top + side + bottom), 255)
    pen = ImageDraw.Draw(page)
    fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
    font = ImageFont.truetype(str(fonts / "DejaVuSans.ttf"), 13)
    low, high = levels
    for number, (panel, label) in enumerate(zip(panels, LABELS, strict=True)):
        grey = np.clip((panel - low) / (high - low) * 255.0, 0.0, 255.0).astype(np.uint8)
        large = cv2.resize(grey, (side, side), interpolation=cv2.INTER_NEAREST)
        left = number * (side + gap)
        page.paste(Image.fromarray(large), (left, top))
        text = f"{label} ({count})" if number == 2 else label
        pen.text((left + 2, 5), text, fill=0, font=font)
    length = round(bar.length_px * ENLARGED)
    y = top + side + 15
    pen.rectangle((side + gap, y - 3, side + gap + length, y + 3), fill=0)
    pen.text(
        (side + gap + length + 10, y - 9), f"{bar.label}   {bar.pixel_size}", fill=0, font=font
    )
    return page


if __name__ == "__main__":
    sys.exit(main())
