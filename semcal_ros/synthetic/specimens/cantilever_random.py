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

"""Cantilevers, substrates and pushes of many looks, drawn at random, so that nothing is tuned to one of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from semcal_ros.synthetic.drift import Drift
from semcal_ros.synthetic.specimens.cantilever import (
    SQUARE_TIP,
    BeamTip,
    CantileverScene,
    Charging,
)
from semcal_ros.synthetic.specimens.substrate import SUBSTRATES, Substrate

#: Names of the outlines of a free end.
TIPS = ("square", "semicircular", "tapered", "chamfered")


@dataclass(frozen=True)
class CantileverExperiment:
    """What is recorded, and how it is pushed and drifts.

    Attributes
    ----------
    tip, substrate
        Names, for tables.
    scene, largest_deflection_m, rotation_rad, drift
        As :func:`~semcal_ros.synthetic.specimens.cantilever.cantilever_plan` takes them.
    """

    tip: str
    substrate: str
    scene: CantileverScene
    largest_deflection_m: float
    rotation_rad: float
    drift: Drift

    @property
    def is_dark(self) -> bool:
        """Whether the beam is darker than the ground."""
        assert self.scene.substrate is not None
        return self.scene.beam < self.scene.substrate.level


def make_tip(name: str, width_m: float, rng: np.random.Generator) -> BeamTip:
    """Make a tip of a kind in :data:`TIPS` for a beam of a width; sizes are drawn where a kind has several."""
    if name == "semicircular":
        return BeamTip(0.5 * width_m, 0.0, "elliptic")
    if name == "tapered":
        return BeamTip(width_m * rng.uniform(0.4, 1.0), rng.uniform(0.15, 0.5))
    if name == "chamfered":
        cut = rng.uniform(0.12, 0.3)
        return BeamTip(cut * width_m, 1.0 - 2.0 * cut)
    return SQUARE_TIP


def random_cantilever(seed: int, *, base_in_view: bool = False) -> CantileverExperiment:
    """Draw an experiment.

    Tips, substrates and contrast take turns with the seed, so that ten seeds hold all of each; sizes,
    levels, texture, charging, direction and push are drawn. What is drawn is what published images of
    microcantilevers show: beams of 30 to 40 um by 2.5 to 4.5 um, pushed by 150 to 300 nm.

    Parameters
    ----------
    seed
        Seed, from 0.
    base_in_view
        Whether the holder will be in view. Without it there is no smooth substrate, on which nothing
        would show the drift.
    """
    rng = np.random.default_rng([seed, 816])
    kinds = SUBSTRATES if base_in_view else SUBSTRATES[:-1]
    # Four tips against five or four substrates: the shift keeps pairs from repeating.
    tip = TIPS[seed % len(TIPS)]
    kind = kinds[(seed + seed // len(kinds)) % len(kinds)]
    dark = seed % 3 == 2
    length_m, width_m = rng.uniform(30e-6, 40e-6), rng.uniform(2.5e-6, 4.5e-6)
    levels = _draw_dark(rng) if dark else _draw_bright(rng)
    contrast = rng.uniform(0.04, 0.1)
    size_m = float(np.exp(rng.uniform(*np.log([0.8e-6, 4e-6]))))
    outline = make_tip(tip, width_m, rng)
    # The pusher touches the straight side, just before the tip.
    touched = length_m - outline.length_m - rng.uniform(0.01, 0.05) * length_m
    turn = rng.uniform(0.0, 2.0 * math.pi)
    halo = rng.uniform(-0.06, 0.1)
    scene = CantileverScene(
        length_m=length_m,
        width_m=width_m,
        pusher_m=(touched, touched + rng.uniform(3e-6, 6e-6)),
        rim=levels["rim"],
        rim_m=rng.uniform(80e-9, 250e-9),
        beam=levels["beam"],
        holder=levels["holder"],
        pusher=levels["pusher"],
        tip=outline,
        substrate=Substrate(_kind(kind), levels["ground"], contrast, size_m, seed),
        charging=Charging(
            (5e3 * math.cos(turn), 5e3 * math.sin(turn)), halo, rng.uniform(0.3e-6, 1.5e-6)
        ),
        push_direction=1 if rng.uniform() < 0.5 else -1,
    )
    drift = Drift(
        velocity_m_s=tuple(rng.normal(0.0, 1e-9, 2)),
        settling_m=tuple(rng.normal(0.0, 80e-9, 2)),
        wander_m=12e-9,
        seed=seed,
    )
    pushed_m, rotation = rng.uniform(150e-9, 300e-9), rng.uniform(-math.pi, math.pi)
    return CantileverExperiment(tip, kind, scene, pushed_m, rotation, drift)


def _kind(name: str) -> Any:
    """Narrow a name to the literal that a substrate takes; the substrate checks it."""
    return name


def _draw_bright(rng: np.random.Generator) -> dict[str, float]:
    beam = rng.uniform(0.55, 0.8)
    return {
        "beam": beam,
        "holder": beam * rng.uniform(0.8, 1.1),
        "pusher": rng.uniform(0.4, 0.7),
        "ground": rng.uniform(0.1, 0.28),
        "rim": rng.uniform(0.05, 0.18),
    }


def _draw_dark(rng: np.random.Generator) -> dict[str, float]:
    """A light element on a heavy one: the rim of a dark beam is weak, or it would outshine the ground."""
    beam = rng.uniform(0.06, 0.16)
    return {
        "beam": beam,
        "holder": beam * rng.uniform(0.9, 1.5),
        "pusher": rng.uniform(0.1, 0.3),
        "ground": rng.uniform(0.55, 0.7),
        "rim": rng.uniform(0.0, 0.06),
    }
