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

"""Sequences that grow with each frame of a recording, and of which every state has its own length."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from semcal_ros.core.drift.thresholds import (
    SEQUENCE_BLOCK,
)

T = TypeVar("T")


@dataclass(frozen=True)
class SharedSequence(Generic[T]):
    """A sequence that never changes; one that is longer by an item shares all but the last block with it.

    Attributes
    ----------
    blocks
        Full blocks.
    rest
        The items after them, fewer than a block.
    """

    blocks: tuple[tuple[T, ...], ...] = ()
    rest: tuple[T, ...] = ()

    @classmethod
    def of(cls, items: Iterable[T]) -> SharedSequence[T]:
        """The sequence of some items."""
        every = tuple(items)
        full = len(every) - len(every) % SEQUENCE_BLOCK
        blocks = tuple(every[k : k + SEQUENCE_BLOCK] for k in range(0, full, SEQUENCE_BLOCK))
        return cls(blocks, every[full:])

    def __len__(self) -> int:
        return SEQUENCE_BLOCK * len(self.blocks) + len(self.rest)

    def __iter__(self) -> Iterator[T]:
        for block in self.blocks:
            yield from block
        yield from self.rest

    def with_item(self, item: T) -> SharedSequence[T]:
        """The sequence with an item more."""
        rest = (*self.rest, item)
        if len(rest) < SEQUENCE_BLOCK:
            return SharedSequence(self.blocks, rest)
        return SharedSequence((*self.blocks, rest))
