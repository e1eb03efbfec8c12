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

"""Does the drift hold on scenes that nobody drew? Grounds, tools and doses of every kind, five seeds of each.

    python -m benchmarks.drift.scenes [--seeds 5] [--only tool,sparse] [--quick] [--time]

A scene is drawn once on a torus, without anything beyond the Nyquist frequency, and moved by its Fourier transform, so
that every drift is exact; what moves otherwise is drawn into each frame, and the electrons are counted with Poisson's
law. None of it shares code with the tracker.

A frame is *wrong* if its drift is off by more than 0.1 px and by more than 3 of its stated sigmas, whatever its status
says. The limit, beyond which the command fails: no frame is wrong, and of a scene that is determined at least 95 % of
the frames are tracked. The bound is that of Cramer and Rao for one frame against a reference without noise, from what
of the specimen is in sight; the first frame, to which the drift refers, has an error of that size, too.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.table import show
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.core.drift.tracker import DriftTracker

SIZE, TORUS, FRAMES = 384, 640, 30
WRONG_PX, WRONG_SIGMAS, LEAST_TRACKED = 0.1, 3.0, 0.95

Floats = NDArray[np.float64]
Rng = np.random.Generator


# -- grounds: (TORUS, TORUS), some 0 to 1 --------------------------------------------------------


def _discs(rng: Rng, count: int, radii: tuple[float, float], level: tuple[float, float]) -> Floats:
    """Soft discs at random places, four times oversampled."""
    out = np.zeros((TORUS, TORUS))
    edge_px, most = 0.6, 50
    for _ in range(count):
        centre = rng.uniform(0, TORUS, 2)
        r, bright = rng.uniform(*radii), rng.uniform(*level)
        # Farther away a disc is as dark as it gets.
        reach = int(np.ceil(r + edge_px * most)) + 1
        beside = np.arange(min(2 * reach + 1, TORUS)) - reach
        x, y = ((int(c) + beside) % TORUS for c in centre)
        dx, dy = (
            (at - c + TORUS / 2) % TORUS - TORUS / 2 for at, c in zip((x, y), centre, strict=True)
        )
        away = np.hypot(dx[None, :], dy[:, None]) - r
        inside = 1.0 / (1.0 + np.exp(np.clip(away / edge_px, -most, most)))
        part = np.ix_(y, x)
        out[part] = np.maximum(out[part], bright * inside)
    return out


def _spectrum(rng: Rng, power: Callable[[Floats], Floats]) -> Floats:
    """A random ground with a power spectrum over the frequency, cycles per px; mean 0.5, deviation 0.17."""
    f = np.hypot(np.fft.fftfreq(TORUS)[:, None], np.fft.rfftfreq(TORUS)[None, :])
    f[0, 0] = 1.0
    noise = np.fft.rfft2(rng.normal(size=(TORUS, TORUS))) * np.sqrt(power(f))
    noise[0, 0] = 0.0
    out = np.fft.irfft2(noise, (TORUS, TORUS))
    return np.asarray(0.5 + 0.17 * out / out.std())


def _lines(rng: Rng, count: int, widths: tuple[int, int], angles: tuple[float, float]) -> Floats:
    """Straight fibres; oversampled by OpenCV's fixed point."""
    out = np.zeros((TORUS, TORUS), dtype=np.uint8)
    for _ in range(count):
        cx, cy = rng.uniform(0, TORUS, 2)
        a = rng.uniform(*angles)
        step = 2000.0 * np.array([np.cos(a), np.sin(a)])
        ends = [tuple(int(16 * v) for v in (np.array([cx, cy]) + k * step)) for k in (-1, 1)]
        level = int(rng.uniform(60, 230))
        cv2.line(out, ends[0], ends[1], level, int(rng.integers(*widths)), cv2.LINE_AA, 4)
    return cv2.GaussianBlur(out, (0, 0), 1.2).astype(np.float64) / 255.0


def gold(rng: Rng) -> Floats:
    return 0.12 + _discs(rng, 420, (2.0, 9.0), (0.25, 0.7))


def sparse(rng: Rng) -> Floats:
    return 0.2 + _discs(rng, 40, (3.0, 6.0), (0.4, 0.8))


def few(rng: Rng) -> Floats:
    """Ten particles in the middle of what is seen, and none elsewhere."""
    y, x = np.mgrid[:TORUS, :TORUS].astype(np.float64)
    out = np.full((TORUS, TORUS), 0.3)
    for _ in range(10):
        px, py = 0.5 * TORUS + rng.uniform(-0.22, 0.22, 2) * SIZE
        r, bright = rng.uniform(3.0, 7.0), rng.uniform(0.2, 0.5)
        out += bright / (1.0 + np.exp(np.clip((np.hypot(x - px, y - py) - r) / 0.6, -50.0, 50.0)))
    return out


def lattice(rng: Rng, defects: int = 14) -> Floats:
    # Whole periods fit into the torus.
    m, n = int(rng.integers(50, 75)), int(rng.integers(4, 30))
    y, x = np.mgrid[:TORUS, :TORUS] / TORUS
    u, v = 2 * np.pi * (m * x + n * y), 2 * np.pi * (-n * x + m * y)
    out = 0.3 + 0.1 * (np.cos(u) + np.cos(v))
    if defects:
        out = out + _discs(rng, defects, (3.0, 5.0), (0.25, 0.4)) * rng.choice([-1, 1])
    return out


def powder(rng: Rng) -> Floats:
    """Particles of a few pixels."""
    return 0.2 + _discs(rng, 300, (0.7, 1.5), (0.3, 0.7))


def pads(rng: Rng) -> Floats:
    """Squares along the rows, half of the pitch wide, with few particles."""
    # Whole pitches fit into the torus.
    pitch = TORUS / int(rng.integers(6, 14))
    off = rng.uniform(0.0, pitch, 2)
    y, x = (
        np.clip(0.25 * pitch - np.abs((np.arange(TORUS) - o) % pitch - 0.5 * pitch) + 0.5, 0.0, 1.0)
        for o in off
    )
    return 0.25 + 0.35 * y[:, None] * x[None, :] + _discs(rng, 10, (2.0, 4.0), (0.3, 0.5))


def ridges(rng: Rng) -> Floats:
    field = _spectrum(rng, lambda f: np.exp(-(((f - 0.05) / 0.012) ** 2)))
    return np.asarray(0.3 + 0.25 * np.tanh(3.0 * (field - 0.5) / 0.17))


def pillars(rng: Rng) -> Floats:
    """On a jittered lattice, no two alike."""
    out = np.full((TORUS, TORUS), 0.2)
    y, x = np.mgrid[:TORUS, :TORUS].astype(np.float64)
    for cy in np.arange(20, TORUS, 40):
        for cx in np.arange(20, TORUS, 40):
            px, py = np.array([cx, cy]) + rng.normal(0, 2.5, 2)
            r = rng.uniform(6, 11)
            out += 0.4 / (1.0 + np.exp(np.clip((np.hypot(x - px, y - py) - r) / 0.7, -50, 50)))
    return out


def pores(rng: Rng) -> Floats:
    """As of anodic alumina: nearly a lattice of hexagons, of which none is in its place."""
    rows, columns = 4 * int(rng.integers(12, 20)), 2 * int(rng.integers(20, 35))
    wide, high = TORUS / columns, TORUS / rows
    off = rng.uniform(0.03, 0.08) * min(wide, high)
    out = np.full((TORUS, TORUS), 0.6)
    near = np.arange(-int(wide + high), int(wide + high) + 1)
    for row in range(rows):
        for column in range(columns):
            x, y = (column + 0.5 * (row % 2)) * wide, row * high
            x, y = np.array([x, y]) + rng.normal(0.0, off, 2)
            r = min(wide, high) * rng.normal(0.32, 0.02)
            px, py = int(x) + near, int(y) + near
            inside = np.hypot(px[None, :] - x, py[:, None] - y)
            dark = 0.35 / (1.0 + np.exp(np.clip((inside - r) / 0.6, -50.0, 50.0)))
            out[np.ix_(py % TORUS, px % TORUS)] -= dark
    return out


def dusty_grating(rng: Rng) -> Floats:
    """Lines with particles on them, which alone tell the place along the lines."""
    m, n = int(rng.integers(30, 80)), int(rng.integers(2, 20))
    y, x = np.mgrid[:TORUS, :TORUS] / TORUS
    lines = 0.3 + 0.12 * np.tanh(3.0 * np.cos(2 * np.pi * (m * x + n * y)))
    return lines + _discs(rng, 150, (3.0, 6.0), (0.25, 0.4))


def holes(rng: Rng) -> Floats:
    return 0.6 - _discs(rng, 120, (5.0, 13.0), (0.3, 0.5))


def membrane(rng: Rng) -> Floats:
    """One soft edge with a bright rim, that of a cell larger than the field; nothing is in it or beside it."""
    y, x = np.indices((TORUS, TORUS)) - 0.5 * TORUS
    middle = rng.uniform(-40.0, 40.0, 2) - [0.7 * SIZE, 0.0]
    angle = np.arctan2(y - middle[1], x - middle[0]) + rng.uniform(0, 2 * np.pi)
    radius = 0.7 * SIZE * (1.0 + 0.1 * np.sin(3 * angle) + 0.05 * np.sin(7 * angle))
    beyond = np.hypot(x - middle[0], y - middle[1]) - radius
    inside = 1.0 / (1.0 + np.exp(np.clip(beyond / 4.0, -50.0, 50.0)))
    return np.asarray(0.35 + 0.3 * inside + 0.25 * np.exp(-((beyond / 5.0) ** 2)))


def clouds(rng: Rng) -> Floats:
    return _spectrum(rng, lambda f: np.exp(-((f * 35.0) ** 2)))


def fractal(rng: Rng) -> Floats:
    return _spectrum(rng, lambda f: f**-2.0 * np.exp(-((f / 0.2) ** 2)))


def faint(rng: Rng) -> Floats:
    """A rough ground whose deviation is 12 % of its brightness."""
    return 0.5 + 0.35 * (fractal(rng) - 0.5)


def fine(rng: Rng) -> Floats:
    return _spectrum(rng, lambda f: np.exp(-((f / 0.12) ** 2)))


def fibres(rng: Rng) -> Floats:
    return 0.15 + _lines(rng, 60, (2, 5), (0.0, np.pi))


def wires(rng: Rng) -> Floats:
    """Nearly all in two directions."""
    return 0.15 + np.maximum(
        _lines(rng, 14, (4, 9), (0.1, 0.2)), _lines(rng, 9, (4, 9), (1.5, 1.7))
    )


def scratches(rng: Rng) -> Floats:
    return 0.25 + 0.6 * _lines(rng, 90, (2, 4), (0.3, 0.3001))


def flat(rng: Rng) -> Floats:
    return np.full((TORUS, TORUS), 0.3)


# -- what is drawn into each frame ---------------------------------------------------------------


@dataclass(frozen=True)
class Frame:
    """A picture without noise, where it shows the specimen, and what is drawn over the electrons (else NaN)."""

    picture: Floats
    shown: Floats
    drawn: Floats | None = None


Foreground = Callable[[Frame, int, Rng], Frame]


def _polygon(frame: Frame, corners: Floats, level: float, stripes: float = 0.0) -> Frame:
    mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(corners * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    part = cv2.GaussianBlur(mask, (0, 0), 0.8).astype(np.float64) / 255.0
    rows = level + stripes * np.sin(np.arange(SIZE) / 7.0)[:, None]
    return Frame(frame.picture * (1 - part) + rows * part, frame.shown * (1 - part))


def tool(frame: Frame, k: int, rng: Rng) -> Frame:
    """A tip that comes in from the left and covers up to half of the field."""
    return _tip(frame, -15.0 + 0.55 * SIZE * k / FRAMES, rng)


def tool_from_start(frame: Frame, k: int, rng: Rng) -> Frame:
    """The same, in sight from the first frame on."""
    return _tip(frame, 20.0 + 0.48 * SIZE * k / FRAMES, rng)


def _tip(frame: Frame, x: float, rng: Rng) -> Frame:
    top, bottom = rng.uniform(-40, 0), SIZE + rng.uniform(0, 40)
    middle = rng.uniform(140, 240)
    return _polygon(
        frame,
        np.array([[-50, top], [x * 0.7, top], [x, middle], [x * 0.7, bottom], [-50, bottom]]),
        0.75,
        0.1,
    )


def two_tools(frame: Frame, k: int, rng: Rng) -> Frame:
    reach = 10.0 + 90.0 * k / FRAMES
    for side in (0, 1):
        y = rng.uniform(100, 280)
        tip = reach if side == 0 else SIZE - reach
        base = -30.0 if side == 0 else SIZE + 30.0
        frame = _polygon(frame, np.array([[base, y - 45], [tip, y], [base, y + 45]]), 0.8)
    return frame


def textured_tool(frame: Frame, k: int, rng: Rng) -> Frame:
    """As rough as the ground, and slow: it moves by a third of a pixel a frame."""
    grain = np.random.default_rng(int(rng.integers(1 << 30))).normal(size=(SIZE, SIZE))
    rough = cv2.GaussianBlur(grain, (0, 0), 2.0)
    shift = np.float32([[1, 0, 0.33 * k], [0, 1, -0.2 * k]])
    moved = cv2.warpAffine(
        rough / rough.std(), shift, (SIZE, SIZE), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP
    )
    x = 110.0 + 0.33 * k
    mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
    cv2.fillPoly(
        mask,
        [np.array([[-10, 60], [round(x), 110], [round(x), 280], [-10, 330]], np.int32)],
        255,
        cv2.LINE_AA,
    )
    part = cv2.GaussianBlur(mask, (0, 0), 0.8).astype(np.float64) / 255.0
    picture = frame.picture * (1 - part) + (0.5 + 0.12 * moved) * part
    return Frame(picture, frame.shown * (1 - part))


def tool_at_rest(frame: Frame, k: int, rng: Rng) -> Frame:
    """A slender one, in sight from the first frame on, that does not move with the specimen."""
    y, x = rng.uniform(100, 280), rng.uniform(0.62, 0.75) * SIZE
    end = np.array([[SIZE + 20, y - 45], [x, y - 5], [x, y + 5], [SIZE + 20, y + 20]])
    return _polygon(frame, end, 0.7, 0.05)


def rolling(frame: Frame, k: int, rng: Rng) -> Frame:
    """A ball in the middle, held in its place, that rolls off after a third of the frames."""
    x, y = np.array([0.4, 0.35]) * SIZE + max(k - FRAMES // 3, 0) * np.array([3.0, 2.0])
    a = np.linspace(0, 2 * np.pi, 60)
    return _polygon(frame, np.stack([x + 18 * np.cos(a), y + 18 * np.sin(a)], axis=1), 0.8)


def pushed(frame: Frame, k: int, rng: Rng) -> Frame:
    """A large particle that is pushed by a thin tip."""
    x, y = 120.0 + 3.0 * k, 190.0 + 8.0 * np.sin(k / 6.0)
    frame = _polygon(frame, np.array([[-20, y - 12], [x - 30, y], [-20, y + 12]]), 0.8)
    a = np.linspace(0, 2 * np.pi, 60)
    return _polygon(frame, np.stack([x + 26 * np.cos(a), y + 26 * np.sin(a)], axis=1), 0.65)


def gripper(frame: Frame, k: int, rng: Rng) -> Frame:
    """A slender tip at rest in sight, which from the ninth frame on pushes a particle across the field."""
    y, x = rng.uniform(120, 270), 300.0 - 3.0 * max(k - 8, 0)
    base = np.array([[SIZE + 20, y - 26], [x + 10, y - 4], [x + 10, y + 4], [SIZE + 20, y + 26]])
    a = np.linspace(0, 2 * np.pi, 40)
    frame = _polygon(frame, np.stack([x + 12 * np.cos(a), y + 12 * np.sin(a)], axis=1), 0.7)
    return _polygon(frame, base, 0.75)


def closing_tips(frame: Frame, k: int, rng: Rng) -> Frame:
    """Two slender tips in sight from the first frame on, which meet in the middle, rest there, and part again."""
    gap, y = (
        4.0 * max(FRAMES // 2 - 3 - k, 0) + 3.0 * max(k - FRAMES // 2 - 3, 0),
        rng.uniform(140, 240),
    )
    for base, tip, wide in (
        (-40.0, 0.5 * (SIZE - gap), 36.0),
        (SIZE + 40.0, 0.5 * (SIZE + gap), 40.0),
    ):
        end = np.array([[base, y - wide], [tip, y - 5], [tip, y + 5], [base, y + wide]])
        frame = _polygon(frame, end, 0.7, 0.02)
    return frame


def shadow(frame: Frame, k: int, rng: Rng) -> Frame:
    """Of a tool above, soft, over a third of the field."""
    x = 60.0 + 4.0 * k
    dark = 1.0 - 0.6 / (1.0 + np.exp((np.arange(SIZE)[None, :] - x) / 12.0))
    return Frame(frame.picture * dark, frame.shown)


def soft_shadow(frame: Frame, k: int, rng: Rng) -> Frame:
    """As soft, as dark and as wide as chance has it, which sweeps over the field in any direction."""
    softness, depth, angle = (
        np.exp(rng.uniform(1.1, 3.4)),
        rng.uniform(0.25, 0.65),
        rng.uniform(0, 2 * np.pi),
    )
    wide = rng.choice([1e4, rng.uniform(60.0, 200.0)])
    front = rng.uniform(-0.6, 0.2) * SIZE + rng.uniform(2.0, 10.0) * k
    y, x = np.mgrid[:SIZE, :SIZE] - 0.5 * SIZE
    behind = front - x * np.cos(angle) - y * np.sin(angle)
    inside, gone = (
        1.0 / (1.0 + np.exp(np.clip(-b / softness, -50.0, 50.0))) for b in (behind, behind - wide)
    )
    return Frame(frame.picture * (1.0 - depth * (inside - gone)), frame.shown)


def data_bar(frame: Frame, k: int, rng: Rng) -> Frame:
    drawn, shown = np.full((SIZE, SIZE), np.nan), frame.shown.copy()
    bar = np.zeros((36, SIZE))
    for x in range(20, 140, 18):
        bar[8:28, x : x + 9] = 0.95
    bar[16:20, 200:340] = 0.95
    drawn[-36:], shown[-36:] = bar, 0.0
    return Frame(frame.picture, shown, drawn)


def counter_in_bar(frame: Frame, k: int, rng: Rng) -> Frame:
    """A black data bar with text, of which one digit is another one in each frame."""
    drawn, shown = np.full((SIZE, SIZE), np.nan), frame.shown.copy()
    bar = np.zeros((36, SIZE), np.uint8)
    text = f"15.0kV x5.00k {k:04d}"
    cv2.putText(bar, text, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 255, 1, cv2.LINE_AA)
    # Black is the least grey level of all.
    drawn[-36:], shown[-36:] = bar / 255.0 * 1.225 - 0.05, 0.0
    return Frame(frame.picture, shown, drawn)


def uneven(frame: Frame, k: int, rng: Rng) -> Frame:
    """Light, or a detector, from one side: a quarter more and a quarter less than in the middle."""
    across = np.linspace(-0.25, 0.25, SIZE)
    return Frame(frame.picture * (1.0 + across[None, :] + 0.4 * across[:, None]), frame.shown)


def spots(frame: Frame, k: int, rng: Rng) -> Frame:
    """Burnt spots of the detector and a cross-hair, which never move."""
    picture, drawn = frame.picture.copy(), np.full((SIZE, SIZE), np.nan)
    drawn[SIZE // 2 - 1 : SIZE // 2 + 1, 40:-40] = 0.95
    drawn[40:-40, SIZE // 2 - 1 : SIZE // 2 + 1] = 0.95
    for _ in range(12):
        x, y = rng.integers(20, SIZE - 20, 2)
        picture[y - 3 : y + 4, x - 3 : x + 4] = 0.05
    return Frame(picture, frame.shown * (picture == frame.picture) * np.isnan(drawn), drawn)


def grabbed(frame: Frame, k: int, rng: Rng) -> Frame:
    """A cross-hair on a screen of which frames were grabbed: it has noise."""
    picture = frame.picture.copy()
    picture[SIZE // 2], picture[:, SIZE // 2] = 1.0, 1.0
    return Frame(picture, frame.shown * (picture == frame.picture))


def charging(frame: Frame, k: int, rng: Rng) -> Frame:
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    return Frame(
        frame.picture * (1.0 + 0.4 * np.sin(3 * x + k / 5.0)) + 0.1 * y * k / FRAMES, frame.shown
    )


def hum(frame: Frame, k: int, rng: Rng) -> Frame:
    """Of the mains, in step with the frames, over a tenth of the grey levels of gold."""
    rows = 0.03 * np.sin(2 * np.pi * (np.arange(SIZE)[:, None] / 8.53 + rng.uniform()))
    return Frame(frame.picture + rows, frame.shown)


def own_lines(frame: Frame, k: int, rng: Rng) -> Frame:
    """Charging that gives each line brightness of its own in each frame."""
    rows = 0.1 * np.random.default_rng(1000 + k).normal(size=(SIZE, 1))
    return Frame(np.clip(frame.picture + rows, 0.0, None), frame.shown)


def columns(frame: Frame, k: int, rng: Rng) -> Frame:
    """A converter for each column, of which none is like the other."""
    return Frame(frame.picture * (1.0 + 0.05 * rng.normal(size=(1, SIZE))), frame.shown)


def nothing(frame: Frame, k: int, rng: Rng) -> Frame:
    return frame


@dataclass(frozen=True)
class Kind:
    """A kind of scene.

    Attributes
    ----------
    ground, foreground
        What is drawn.
    electrons
        Counted per pixel of brightness one.
    step_px
        Drift from frame to frame.
    jump_px, jump_line
        A move of the stage in the middle, and from which part of the lines of that frame on it shows.
    replaced
        Part of the ground in whose place another one of its kind has grown in the last frame.
    determined
        Whether the drift can be known at all.
    """

    ground: Callable[[Rng], Floats]
    foreground: Foreground = nothing
    electrons: float = 60.0
    step_px: float = 0.5
    jump_px: float = 0.0
    jump_line: float = 0.0
    replaced: float = 0.0
    determined: bool = True


KINDS: dict[str, Kind] = {
    "gold": Kind(gold),
    "gold at 2 electrons": Kind(gold, electrons=8.0),
    "sparse at 3 electrons": Kind(sparse, electrons=15.0),
    "faint ground at 4 electrons": Kind(faint, electrons=8.0),
    "tool over faint ground": Kind(faint, tool, electrons=16.0),
    "charging gold": Kind(gold, charging),
    "gold and a stage move": Kind(gold, jump_px=60.0),
    "gold and a move within a frame": Kind(gold, jump_px=60.0, jump_line=0.3),
    "ridges and a move within a frame": Kind(ridges, jump_px=20.0, jump_line=0.4),
    "fast gold": Kind(gold, step_px=3.0),
    "gold that changes": Kind(gold, replaced=0.4),
    "ridges that change": Kind(ridges, replaced=0.4),
    "sparse": Kind(sparse),
    "fine": Kind(fine),
    "fractal": Kind(fractal),
    "clouds": Kind(clouds, electrons=120.0),
    "ridges": Kind(ridges),
    "fibres": Kind(fibres),
    "wires": Kind(wires),
    "pillars": Kind(pillars),
    "holes": Kind(holes),
    "membrane": Kind(membrane),
    "pores": Kind(pores),
    "pores and a jump": Kind(pores, jump_px=20.0),
    "dusty grating": Kind(dusty_grating),
    "lattice": Kind(lattice),
    "pads along the rows": Kind(pads, uneven, electrons=30.0),
    "tool over gold": Kind(gold, tool),
    "tool over sparse": Kind(sparse, tool),
    "tool over gold from the start": Kind(gold, tool_from_start),
    "tool over fine": Kind(fine, tool),
    "tool over ridges": Kind(ridges, tool),
    "tool over a lattice": Kind(lattice, tool),
    "two tools": Kind(gold, two_tools),
    "rough tool": Kind(fine, textured_tool),
    "pushed particle": Kind(gold, pushed),
    "pushed over sparse": Kind(sparse, pushed),
    "gripper over sparse": Kind(sparse, gripper, electrons=15.0),
    "tips that close over sparse": Kind(sparse, closing_tips),
    "tool at rest over few": Kind(few, tool_at_rest),
    "ball over few": Kind(few, rolling),
    "shadow": Kind(gold, shadow),
    "soft shadow over gold": Kind(gold, soft_shadow),
    "soft shadow over holes": Kind(holes, soft_shadow),
    "soft shadow over fibres": Kind(fibres, soft_shadow),
    "data bar": Kind(gold, data_bar),
    "counter over powder": Kind(powder, counter_in_bar),
    "hum over gold": Kind(gold, hum),
    "hum over fibres": Kind(fibres, hum),
    "lines of their own": Kind(gold, own_lines),
    "columns over ridges": Kind(ridges, columns),
    "spots and cross-hair": Kind(gold, spots),
    "grabbed cross-hair": Kind(gold, grabbed),
    "tool over sparse from the start": Kind(sparse, tool_from_start, determined=False),
    "scratches": Kind(scratches, determined=False),
    "tool over scratches": Kind(scratches, tool, determined=False),
    "perfect lattice": Kind(lambda rng: lattice(rng, 0), determined=False),
    "perfect lattice and a jump": Kind(lambda rng: lattice(rng, 0), jump_px=9.0, determined=False),
    "noise": Kind(flat, determined=False),
}


def draw(
    kind: Kind, seed: int, count: int | None = None
) -> tuple[list[NDArray[np.uint8]], Floats, float]:
    """The frames of a scene, or the first of them, its drift (n, 2) in px, and the bound of a frame.

    The bound is in px RMS of both axes together.
    """
    rng = np.random.default_rng(seed)
    grounds = [kind.ground(rng)]
    if kind.replaced:
        grounds.append(kind.ground(rng))
    fx, fy = np.fft.rfftfreq(TORUS)[None, :], np.fft.fftfreq(TORUS)[:, None]
    # Nothing beyond half of the Nyquist frequency, or sampling would alias when it moves.
    low_pass = np.exp(-((np.hypot(fx, fy) / 0.22) ** 2))
    spectra = [np.fft.rfft2(ground) * low_pass for ground in grounds]
    heading = rng.uniform(0, 2 * np.pi)
    steps = kind.step_px * np.array([np.cos(heading), np.sin(heading)]) * np.ones((FRAMES, 1))
    wobble = np.cumsum(rng.normal(0, 0.12 * kind.step_px, (FRAMES, 2)), axis=0)
    drift = np.cumsum(steps + wobble, axis=0)
    drift -= drift[0]
    jump = kind.jump_px * np.array([0.8, -0.6])
    drift[FRAMES // 2 :] += jump
    foreground_seed = int(rng.integers(1 << 30))
    margin = (TORUS - SIZE) // 2
    frames, bounds = [], []

    def show(at_px: Floats, k: int) -> Floats:
        share = kind.replaced * k / (FRAMES - 1)
        spectrum = (1.0 - share) * spectra[0] + share * spectra[-1]
        turned = np.exp(-2j * np.pi * (fx * at_px[0] + fy * at_px[1]))
        moved = np.fft.irfft2(spectrum * turned, (TORUS, TORUS))
        return moved[margin : margin + SIZE, margin : margin + SIZE]

    for k, at_px in enumerate(drift[:count]):
        view = show(at_px, k)
        if kind.jump_line and k == FRAMES // 2:
            first = slice(0, int(kind.jump_line * SIZE))
            view[first] = show(at_px - jump, k)[first]
        clean = kind.foreground(
            Frame(view, np.ones_like(view)), k, np.random.default_rng(foreground_seed)
        )
        level = np.clip(clean.picture, 0.0, None)
        counted = rng.poisson(kind.electrons * level) / kind.electrons
        if clean.drawn is not None:
            counted = np.where(np.isnan(clean.drawn), counted, clean.drawn)
        frames.append(np.clip(np.rint(200.0 * counted + 10.0), 0, 255).astype(np.uint8))
        gy, gx = np.gradient(view)
        precision = clean.shown / np.maximum(level / kind.electrons, 1e-4)
        information = np.array([[np.sum(precision * a * b) for a in (gx, gy)] for b in (gx, gy)])
        bounds.append(np.trace(np.linalg.pinv(information)))
    return frames, drift, float(np.sqrt(np.mean(bounds)))


@dataclass(frozen=True)
class Outcome:
    """One scene: (n,) which frames were tracked, their errors in px, (n, 2), and over sigma; the bound."""

    tracked: NDArray[np.bool_]
    errors: Floats
    scores: Floats
    bound_px: float

    @property
    def wrong(self) -> int:
        """Frames that are wrong in silence."""
        off = np.any(
            (np.abs(self.errors) > WRONG_PX) & (np.abs(self.scores) > WRONG_SIGMAS), axis=1
        )
        return int(np.count_nonzero(off))


def run(kind: Kind, seed: int) -> Outcome:
    """Track a scene as a stream is tracked."""
    frames, drift, bound = draw(kind, seed)
    tracker = DriftTracker()
    updates: list[DriftUpdate] = [tracker.update(f, float(k)) for k, f in enumerate(frames)]
    errors = np.array([u.drift_px for u in updates]) - drift
    sigmas = np.array([np.sqrt(np.diag(u.covariance)[:2]) for u in updates])
    with np.errstate(divide="ignore", invalid="ignore"):
        scores = np.where(sigmas > 0.0, errors / sigmas, 0.0)
    return Outcome(np.array([u.accepted for u in updates]), errors, scores, bound)


def time_frames(names: Sequence[str], seed: int) -> Floats:
    """(kinds, FRAMES) processor time of each frame, s; the scenes take turns, frame by frame."""
    scenes = [draw(KINDS[name], seed)[0] for name in names]
    trackers = [DriftTracker() for _ in names]
    times = np.zeros((len(names), FRAMES))
    for k in range(FRAMES):
        for j, (frames, tracker) in enumerate(zip(scenes, trackers, strict=True)):
            begin_s = time.thread_time()
            tracker.update(frames[k], float(k))
            times[j, k] = time.thread_time() - begin_s
    return times


def show_times(names: Sequence[str], seeds: int) -> None:
    """Time of a frame over that of plain gold: mean of all frames, and median of those after the first five."""
    cv2.setNumThreads(1)
    names = ["gold", *(name for name in names if name != "gold")]
    times = [time_frames(names, 100 + seed) for seed in range(seeds)]
    means = np.array([t.mean(axis=1) for t in times])
    medians = np.array([np.median(t[:, 5:], axis=1) for t in times])
    rows: list[list[object]] = []
    for j, name in enumerate(names):
        ratios = [float(np.mean(t[:, j] / t[:, 0])) for t in (means, medians)]
        worst = float(np.max(means[:, j] / means[:, 0]))
        rows.append([name, 1e3 * float(means[:, j].mean()), ratios[0], worst, ratios[1]])
    header = ["scene", "ms per frame", "over gold", "of the worst seed", "of medians"]
    show("processor time of a frame", header, rows)


def draw_figure(name: str, seed: int, chosen: Sequence[int], path: str) -> None:
    """Write pictures of a scene, as they come, with outlines of what was found to move by itself."""
    frames, _, _ = draw(KINDS[name], seed)
    tracker = DriftTracker()
    shown = []
    for k, frame in enumerate(frames):
        moving = tracker.update(frame, float(k)).moving
        if k not in chosen:
            continue
        picture = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
        if moving is not None:
            mask = moving.draw((frame.shape[1], frame.shape[0]))
            outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            cv2.drawContours(picture, outlines, -1, (0, 0, 0), 5)
            cv2.drawContours(picture, outlines, -1, (163, 143, 255), 2)
        shown.append(cv2.copyMakeBorder(picture, 4, 4, 4, 4, cv2.BORDER_CONSTANT, value=(255,) * 3))
    cv2.imwrite(path, np.hstack(shown), [cv2.IMWRITE_WEBP_QUALITY, 60])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the fleet; 1 beyond the limits."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drift.scenes")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="kinds, separated by commas")
    parser.add_argument("--quick", action="store_true", help="one seed")
    parser.add_argument("--figure", help="write the figure of the documentation instead")
    parser.add_argument("--time", action="store_true", help="the time of a frame instead")
    chosen = parser.parse_args(arguments)
    if chosen.figure:
        draw_figure("tool over gold", 100, (0, 9, 18, 29), chosen.figure)
        return 0
    names = [n.strip() for n in chosen.only.split(",") if n.strip()] or list(KINDS)
    if unknown := [name for name in names if name not in KINDS]:
        parser.error(f"--only {'; '.join(unknown)}; expected some of: {'; '.join(KINDS)}")
    if chosen.time:
        show_times(names, 1 if chosen.quick else chosen.seeds)
        return 0
    rows: list[list[object]] = []
    failed = False
    for name in names:
        kind = KINDS[name]
        found = [run(kind, 100 + s) for s in range(1 if chosen.quick else chosen.seeds)]
        tracked = np.concatenate([o.tracked for o in found])
        errors = np.concatenate([o.errors for o in found])[tracked]
        scores = np.concatenate([o.scores for o in found])[tracked]
        wrong = sum(o.wrong for o in found)
        share = float(tracked.mean())
        failed |= wrong > 0 or (kind.determined and share < LEAST_TRACKED)
        rms = float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) if len(errors) else None
        rows.append(
            [
                name + ("" if kind.determined else " (not determined)"),
                f"{100.0 * share:.0f} %",
                rms,
                float(np.mean([o.bound_px for o in found])) if kind.determined else None,
                float(np.sqrt(np.mean(scores**2))) if len(scores) else None,
                wrong,
            ]
        )
        print(*rows[-1], flush=True)
    header = ["scene", "tracked", "RMS px", "bound px", "error/sigma", "wrong frames"]
    show("drift on scenes", header, rows)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
