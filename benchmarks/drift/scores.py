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

"""What the answers of one method on one group of pairs are worth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.drift.methods import METHODS, Answer, Method
from benchmarks.drift.pairs import Pair

# Farther off than this is no measurement but another place.
WRONG_PX = 1.0
# A method that fails more often than this in a group cannot win it.
MOST_FAILURES = 0.05

HEADER = ["noise  method", "RMS px", "bound px", "RMS/bound", "bias px", "+-", "refused", "wrong"]
HEADER += ["err/sigma", "68 %", "95 %", "time", "cost", "wins"]


@dataclass(frozen=True)
class Score:
    """One row. Accuracy is of one coordinate, over the pairs that were neither refused nor wrong.

    Attributes
    ----------
    rms_px, bound_px
        RMS of the error and of the Cramer-Rao bound.
    bias_px, bias_sigma_px
        Mean error of the coordinate where it is larger, and the standard error of that mean.
    refused, wrong, pairs
        Counts.
    normalised, within_68, within_95
        RMS of the error over the stated sigma; fraction of errors within 1 and 1.96 sigma.
    time
        Ratio to phase correlation.
    """

    method: Method
    rms_px: float = np.nan
    bound_px: float = np.nan
    bias_px: float = np.nan
    bias_sigma_px: float = np.nan
    refused: int = 0
    wrong: int = 0
    pairs: int = 0
    normalised: float = np.nan
    within_68: float = np.nan
    within_95: float = np.nan
    time: float = np.nan

    @property
    def ratio(self) -> float:
        return self.rms_px / self.bound_px

    @property
    def fails(self) -> bool:
        return self.refused + self.wrong > MOST_FAILURES * self.pairs

    @property
    def cost(self) -> float:
        """Time to reach the variance of the bound by averaging; NaN for a method that fails."""
        return np.nan if self.fails else self.ratio**2 * self.time

    def row(self, label: str, wins: str) -> list[object]:
        """Cells under :data:`HEADER`."""
        if self.pairs == 0:
            return [label, "not installed", *[None] * (len(HEADER) - 2)]
        cells = [label, self.rms_px, self.bound_px, self.ratio, self.bias_px, self.bias_sigma_px]
        cells += [self.refused or None, self.wrong or None]
        cells += [self.normalised, self.within_68, self.within_95, self.time]
        return [*cells, "fails" if self.fails else self.cost, wins]


def score(method: Method, pairs: Sequence[Pair], answers: Sequence[Answer], time: float) -> Score:
    """Score of a method that ran."""
    errors, sigmas, bounds, refused, wrong = [], [], [], 0, 0
    for pair, answer in zip(pairs, answers, strict=True):
        if answer is None:
            refused += 1
            continue
        error = answer[0] - pair.shift
        # NaN is wrong too.
        if not np.max(np.abs(error)) < WRONG_PX:
            wrong += 1
            continue
        errors.append(error)
        bounds.append(pair.bound_px)
        if answer[1] is not None:
            sigmas.append(answer[1])
    counts = {"refused": refused, "wrong": wrong, "pairs": len(pairs), "time": time}
    if not errors:
        return Score(method, **counts)
    bias, deviation = _bias(np.array(errors))
    return Score(
        method,
        rms_px=_rms(errors),
        bound_px=_rms(bounds),
        bias_px=bias,
        bias_sigma_px=deviation,
        **counts,
        **(_stated(np.abs(np.array(errors) / np.array(sigmas))) if sigmas else {}),
    )


def _rms(values: Sequence[object]) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values, dtype=np.float64)))))


def _bias(errors: np.ndarray) -> tuple[float, float]:
    mean = errors.mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    if len(errors) < 2:
        return float(abs(mean[axis])), np.nan
    return float(abs(mean[axis])), float(errors[:, axis].std(ddof=1) / np.sqrt(len(errors)))


def _stated(normalised: np.ndarray) -> dict[str, float]:
    return {
        "normalised": _rms(normalised),
        "within_68": float(np.mean(normalised < 1.0)),
        "within_95": float(np.mean(normalised < 1.96)),
    }


def winners(scores: Iterable[Score]) -> dict[str, Method]:
    """Whose cost is least, for a single ``pair`` and for a further image of a ``stream``."""
    able = [s for s in scores if s.cost == s.cost]
    tasks = {"pair": [s for s in able if not s.method.stream_only], "stream": able}
    return {task: min(few, key=lambda s: s.cost).method for task, few in tasks.items() if few}


def rows(scores: Sequence[Score], label: str) -> list[list[object]]:
    """Rows of one group of pairs, the winners marked."""
    best = winners(scores)
    return [
        s.row(f"{label}  {s.method.name}", ", ".join(t for t, m in best.items() if m is s.method))
        for s in scores
    ]


SUMMARY_HEADER = ["method", "groups", "fails in", "pair won", "stream won", "refused", "wrong"]
SUMMARY_HEADER += ["RMS/bound", "worst", "err/sigma", "time", "cost"]


def summary(groups: Sequence[Sequence[Score]]) -> list[list[object]]:
    """One row per method over all groups; medians are over the groups in which it does not fail."""
    best = [winners(group) for group in groups]
    out: list[list[object]] = []
    for method in METHODS:
        mine = [s for group in groups for s in group if s.method is method and s.pairs]
        if not mine:
            out.append([method.name, "not installed", *[None] * (len(SUMMARY_HEADER) - 2)])
            continue
        good = [s for s in mine if not s.fails]
        won = [sum(b.get(task) is method for b in best) for task in ("pair", "stream")]
        out.append(
            [method.name, len(mine), len(mine) - len(good)]
            + [None if method.stream_only else won[0], won[1]]
            + [sum(s.refused for s in mine), sum(s.wrong for s in mine)]
            + [_median([s.ratio for s in good]), max((s.ratio for s in good), default=np.nan)]
            + [_median([s.normalised for s in good])]
            + [_median([s.time for s in good]), _median([s.cost for s in good])]
        )
    return out


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if value == value]
    return float(np.median(known)) if known else np.nan
