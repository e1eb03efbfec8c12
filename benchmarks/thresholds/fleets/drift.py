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

"""Small streams of the scenes of ``benchmarks.drift.scenes``, tracked as they come. Errors are in px."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.thresholds.answers import Answer, digest_of
from semcal_ros.core.drift.tracker import DriftTracker

SCENES = (
    "gold",
    "gold and a stage move",
    "sparse",
    "lattice",
    "tool over gold",
    "pushed particle",
    "data bar",
    "spots and cross-hair",
)
SIZE, FRAMES, SEED = 192, 12, 100
WRONG_PX, WRONG_SIGMAS = 0.1, 3.0


def draw() -> dict[str, Any]:
    """Draw the frames."""
    # Not where they are tracked: each run imports what it needs.
    from benchmarks.drift import scenes

    # Of the scenes' own pictures, smaller ones, and fewer.
    scenes.SIZE, scenes.FRAMES = SIZE, FRAMES
    return {name: scenes.draw(scenes.KINDS[name], SEED)[:2] for name in SCENES}


def run(case: Any) -> Answer:
    """Track a stream."""
    frames, drift = case
    start = time.process_time()
    tracker = DriftTracker()
    updates = [tracker.update(frame, float(k)) for k, frame in enumerate(frames)]
    seconds = time.process_time() - start
    accepted = np.array([u.accepted for u in updates])
    found = np.array([u.drift_px for u in updates])
    covariances = np.array([u.covariance for u in updates])
    error, used = found - drift, accepted.copy()
    used[0] = False
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, :2])
    with np.errstate(divide="ignore", invalid="ignore"):
        score = np.where(sigmas > 0.0, np.abs(error) / sigmas, 0.0)
    wrong = np.any((np.abs(error) > WRONG_PX) & (score > WRONG_SIGMAS), axis=1)
    moving = [u.moving for u in updates]
    bits = digest_of(found, covariances, "".join(u.status.name for u in updates))
    parted = sum(m is not None for m in moving)
    return Answer(
        f"{int(accepted.sum())} tracked, {parted} parted",
        int(accepted.sum()),
        float(np.sqrt(np.mean(error[used] ** 2))) if used.any() else float("nan"),
        float(np.abs(error[used]).max()) if used.any() else float("nan"),
        float(np.sqrt(np.mean(score[used] ** 2))) if used.any() else float("nan"),
        int(wrong.sum()),
        bits,
        seconds,
    )
