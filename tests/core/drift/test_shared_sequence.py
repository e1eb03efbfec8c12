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

"""A sequence that is shared between the states that it grows with."""

from __future__ import annotations

from semcal_ros.core.drift.shared_sequence import SharedSequence


def test_a_longer_sequence_leaves_the_shorter_one_and_shares_its_blocks() -> None:
    sequence: SharedSequence[int] = SharedSequence()
    held = []
    for k in range(700):
        held.append(sequence)
        sequence = sequence.with_item(k)
    assert [len(s) for s in held] == list(range(700))
    assert list(sequence) == list(range(700)) and list(held[300]) == list(range(300))
    assert len(sequence.blocks) == 5 and sequence.blocks[1] is held[300].blocks[1]
    # Made at once it is the same, at the edges of the blocks as well.
    for count in (0, 1, 127, 128, 129, 256):
        assert SharedSequence.of(range(count)) == held[count]
