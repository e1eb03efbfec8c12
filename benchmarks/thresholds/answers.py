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

"""What a fleet answers, and what of it changes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

# What counts as a change: of the error, of its ratio to the stated sigma, of the number of points or frames.
ERROR_CHANGE, COUNT_CHANGE = 0.05, 0.02
# And of the error of one case alone, which a few points may change.
CASE_CHANGE = 0.3


@dataclass(frozen=True)
class Answer:
    """What was made of one case.

    Attributes
    ----------
    decision
        In a word, what it was taken for, or why not.
    count
        Points that were found, or frames that were tracked.
    error, worst
        RMS and largest error against the truth, in the unit of the fleet; NaN without one.
    ratio
        RMS of the error over its stated sigma.
    wrong
        Answers that are wrong in silence.
    digest
        Of all numbers of the answer, to the last bit.
    seconds
        Of the processor.
    """

    decision: str
    count: int = 0
    error: float = float("nan")
    worst: float = float("nan")
    ratio: float = float("nan")
    wrong: int = 0
    digest: str = ""
    seconds: float = 0.0


def refusal(error: Exception, seconds: float) -> Answer:
    """What was refused, with its reason; the numbers in that are no part of the decision."""
    said = str(error)
    words = " ".join(word for word in said.split() if word.isalpha())[:60]
    return Answer(f"refused: {words}", digest=digest_of(said), seconds=seconds)


def digest_of(*values: object) -> str:
    """Bits of numbers and arrays, in short."""
    found = hashlib.sha1(usedforsecurity=False)
    for value in values:
        found.update(np.asarray(value).tobytes() if not isinstance(value, str) else value.encode())
    return found.hexdigest()


@dataclass(frozen=True)
class Difference:
    """How the answers of a fleet differ from those without a change.

    Attributes
    ----------
    identical
        To the last bit.
    decisions
        Cases that are decided otherwise, with both words.
    wrong
        Answers that are wrong in silence, more or fewer.
    error, ratio, count, seconds
        Relative change: geometric mean of the cases' errors, RMS of error over sigma, sum of points or frames, time.
    case_error, case
        The largest relative change of the error of a case, and which one.
    raised
        What ended the process; empty otherwise.
    """

    identical: bool
    decisions: tuple[str, ...] = ()
    wrong: int = 0
    error: float = 0.0
    ratio: float = 0.0
    count: float = 0.0
    seconds: float = 0.0
    case_error: float = 0.0
    case: str = ""
    raised: str = ""

    @property
    def is_alike(self) -> bool:
        """Whether nothing changes beyond the limits."""
        return not (
            self.raised
            or self.decisions
            or self.wrong
            or abs(self.error) > ERROR_CHANGE
            or abs(self.ratio) > ERROR_CHANGE
            or abs(self.count) > COUNT_CHANGE
            or abs(self.case_error) > CASE_CHANGE
        )

    def __str__(self) -> str:
        if self.raised:
            return self.raised
        if self.identical:
            return "identical"
        parts = [f"error {self.error:+.1%}, /sigma {self.ratio:+.1%}, count {self.count:+.1%}"]
        parts += (
            [f"{self.case} {self.case_error:+.0%}"] if abs(self.case_error) > CASE_CHANGE else []
        )
        parts += [f"wrong {self.wrong:+d}"] if self.wrong else []
        return "; ".join([*parts, *self.decisions])


def compare(usual: Mapping[str, Answer], other: Mapping[str, Answer]) -> Difference:
    """Compare the answers of two runs of a fleet."""
    names = [name for name in usual if name in other]
    pairs = [(name, usual[name], other[name]) for name in names]
    logs = {
        name: float(np.log(b.error / a.error))
        for name, a, b in pairs
        if a.error > 0.0 and b.error > 0.0
    }
    case = max(logs, key=lambda name: abs(logs[name]), default="")
    both = [(a.ratio, b.ratio) for _, a, b in pairs if np.isfinite(a.ratio + b.ratio)]
    before, after = np.sqrt(np.mean(np.square(both), axis=0)) if both else (1.0, 1.0)
    count = sum(a.count for _, a, _ in pairs)
    time_s = sum(a.seconds for _, a, _ in pairs)
    return Difference(
        all(a.digest == b.digest and a.decision == b.decision for _, a, b in pairs),
        tuple(
            f"{name}: {a.decision} -> {b.decision}"
            for name, a, b in pairs
            if a.decision != b.decision
        ),
        sum(b.wrong - a.wrong for _, a, b in pairs),
        float(np.expm1(np.mean(list(logs.values())))) if logs else 0.0,
        float(after / before - 1.0) if before > 0.0 else 0.0,
        sum(b.count for _, _, b in pairs) / count - 1.0 if count else 0.0,
        sum(b.seconds for _, _, b in pairs) / time_s - 1.0 if time_s else 0.0,
        float(np.expm1(logs[case])) if case else 0.0,
        case,
    )
