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

"""Pairs of pictures with true shifts, for registration: specimens, doses, tools, overlays, lattices, lines, and noise.

From ``benchmarks.drift.pairs`` and ``benchmarks.drift.scenes``, smaller than there. Errors are in px, of one
coordinate.
"""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np

from benchmarks.thresholds.answers import Answer, digest_of
from semcal_ros.core.registration.affine import NotAlignedError, align_affine
from semcal_ros.core.registration.register import Registration, prepare_reference, register

SIZE, REACH_PX = 224, 40.0
# Kind, noise in dB, shift in px, the 1-sigma of a prediction (none is given where it is 0), and draws of the noise.
PAIRS = {
    "gold": ("gold", 10.0, (2.3, -1.4), 0.0, 4),
    "gold far": ("gold", 20.0, (-31.6, 22.2), 0.0, 4),
    "gold predicted": ("gold", 20.0, (3.4, 5.6), 2.0, 4),
    "faint texture": ("texture", 0.0, (1.7, 0.6), 0.0, 4),
    "few particles": ("sparse", 15.0, (-3.2, 2.9), 0.0, 4),
    "grid": ("grid", 20.0, (2.6, 1.9), 0.0, 1),
    "grid predicted": ("grid", 20.0, (2.6, 1.9), 2.0, 2),
}
# Of a scene: numbers of the reference and of the images after it, and the 1-sigma of their predictions.
SCENES = {
    "gold at 2 electrons": (0, (2, 4, 6, 8), 0.0),
    "charging gold": (0, (2, 4, 6, 8), 0.0),
    "sparse": (0, (2, 4, 6, 8), 0.0),
    "clouds": (0, (2, 4, 6, 8), 1.0),
    "lattice": (0, (2, 4), 1.0),
    "perfect lattice": (0, (3,), 1.0),
    "scratches": (0, (4,), 1.0),
    "noise": (0, (4,), 1.0),
    "tool over gold": (4, (6, 8), 1.0),
    "tool over fine": (4, (5, 6, 7, 8), 1.0),
    "tool over sparse": (4, (6, 7), 1.0),
    "two tools": (4, (6, 7), 1.0),
    "rough tool": (2, (4, 5, 6, 7), 0.3),
    "pushed particle": (2, (4, 5, 6), 0.3),
    "tool over sparse from the start": (0, (3, 5, 7, 9), 1.0),
    "ball over few": (0, (2, 5, 7, 9), 1.0),
    "data bar": (0, (2, 4, 6, 8), 1.0),
    "shadow": (0, (3, 6, 9), 0.5),
    "soft shadow over gold": (0, (3, 6, 9), 0.5),
    "soft shadow over holes": (0, (3, 6, 9), 0.5),
    "tool over faint ground": (4, (6, 8), 1.0),
}
SCENE_PX, FRAMES, SEED = 256, 10, 100
BAR_PX = 36
FAR_PX, FAR_SIGMAS = 0.1, 4.0


def draw() -> dict[str, Any]:
    """Draw the pairs."""
    # Not where they are registered: each run imports what it needs, which takes a good part of its time.
    from benchmarks.drift import scenes
    from benchmarks.drift.pairs import Scene, Views

    cases: dict[str, Any] = {}
    kinds = dict.fromkeys(kind for kind, *_ in PAIRS.values())
    for kind in kinds:
        scene = Scene(kind, SIZE, REACH_PX)
        for name, (own, noise_db, shift, sigma_px, draws) in PAIRS.items():
            if own == kind:
                views = Views(scene, [shift] * draws).pairs(noise_db, 8, sigma_px, (1, 2))
                images = [(v.image, shift, v.guess_px if sigma_px else None) for v in views]
                cases[name] = (views[0].reference, images, sigma_px, None)
    picture = cases["gold"][0]
    plain = cases["gold far"][0]
    middle = (0.5 * (SIZE - 1), 0.5 * (SIZE - 1))
    turn = cv2.getRotationMatrix2D(middle, 4.0, 1.0)
    turned = cv2.warpAffine(plain, turn, (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT)
    cases["other specimen"] = (picture, [(cases["faint texture"][0], None, None)], 0.0, None)
    cases["negative"] = (plain, [(255 - cases["gold far"][1][0][0], None, None)], 0.0, None)
    cases["turned"] = (plain, [(turned, None, None)], 0.0, None)
    little = np.array([[1.004, 0.003, 1.2], [-0.002, 0.997, -0.7]])
    bent = cv2.warpAffine(plain, little, (SIZE, SIZE), flags=cv2.INTER_CUBIC)
    rng = np.random.default_rng(3)
    pair = [np.float32(p + rng.normal(0.0, 4.0, p.shape)) for p in (plain[40:-40, 40:-40], bent)]
    cases["affine"] = ("affine", pair, little)
    # Of the scenes' own pictures, smaller ones, and less of a drift.
    scenes.SIZE, scenes.FRAMES = SCENE_PX, FRAMES
    rng = np.random.default_rng(4)
    for name, (first, then, sigma_px) in SCENES.items():
        frames, drift, _ = scenes.draw(scenes.KINDS[name], SEED)
        known = name not in ("perfect lattice", "scratches", "noise")
        images = []
        for k in then:
            shift = drift[k] - drift[first]
            guess = shift + rng.normal(0.0, sigma_px, 2) if sigma_px else None
            images.append((frames[k], shift if known else None, guess))
        fixed = None
        if name == "data bar":
            fixed = np.zeros((SCENE_PX, SCENE_PX), dtype=bool)
            fixed[-BAR_PX:] = True
        cases[name] = (frames[first], images, sigma_px, fixed)
    return cases


def run(case: Any) -> Answer:
    """Register the images of a case, each with what moved in the one before."""
    start = time.process_time()
    if isinstance(case[0], str):
        template, image = case[1]
        return _affine(template, image, case[2], start)
    picture, images, sigma_px, fixed = case
    reference = prepare_reference(picture, fixed=fixed)
    moving, found, errors, scores = None, [], [], []
    for image, shift, guess in images:
        has = guess is not None
        own = register(
            reference,
            image,
            guess_px=guess if has else (0.0, 0.0),
            guess_covariance=np.eye(2) * sigma_px**2 if has else None,
            suspected=moving,
            takes_lines=has,
            fixed=fixed,
        )
        moving = own.moving
        found.append(own)
        if own.accepted and shift is not None:
            errors.append(own.shift_px - shift)
            scores.append(np.abs(errors[-1]) / np.sqrt(np.diag(own.covariance)))
    seconds = time.process_time() - start
    words = [_word(own) for own in found]
    decision = ", ".join(f"{words.count(word)} {word}" for word in dict.fromkeys(words))
    accepted = sum(own.accepted for own in found)
    bits = digest_of(*(_numbers(own) for own in found))
    if not errors:
        return Answer(decision, accepted, digest=bits, seconds=seconds)
    off, score = np.abs(errors), np.array(scores)
    wrong = np.any((off > FAR_PX) & (score > FAR_SIGMAS), axis=1)
    return Answer(
        decision,
        accepted,
        float(np.sqrt(np.mean(off**2))),
        float(off.max()),
        float(np.sqrt(np.mean(score**2))),
        int(wrong.sum()),
        bits,
        seconds,
    )


def _word(own: Registration) -> str:
    if own.rejection is not None:
        return own.rejection.status.name.lower()
    return "across" if own.along is not None else "parted" if own.moving is not None else "whole"


def _numbers(own: Registration) -> str:
    fit = own.fit_similarity() if own.accepted else None
    share = None if own.moving is None else own.moving.share
    values = (own.shift_px, own.covariance, own.correlation, own.contrast, own.share, own.reason)
    parts = [*values, share, None if fit is None else fit.values]
    return repr([part.tobytes() if isinstance(part, np.ndarray) else part for part in parts])


def _affine(template: Any, image: Any, true: Any, start: float) -> Answer:
    """The map of a template onto the picture that it was cut from; errors at its corners."""
    try:
        found = align_affine(template, image)
    except NotAlignedError as error:
        return Answer("not aligned", digest=digest_of(str(error)))
    ends = np.array([[x, y] for x in (40.0, SIZE - 41.0) for y in (40.0, SIZE - 41.0)])
    seconds = time.process_time() - start
    seen = (ends - 40.0) @ found.matrix.T + found.shift_px
    off = seen - (ends @ true[:, :2].T + true[:, 2])
    score = (found.matrix - true[:, :2]).ravel() / np.sqrt(np.diag(found.covariance))
    bits = digest_of(found.matrix, found.shift_px, found.covariance, found.correlation)
    error, worst = float(np.sqrt(np.mean(off**2))), float(np.abs(off).max())
    ratio = float(np.sqrt(np.mean(score**2)))
    return Answer("aligned", 1, error, worst, ratio, 0, bits, seconds)
