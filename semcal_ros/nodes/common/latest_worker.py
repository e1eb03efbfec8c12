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

"""Work in a thread beside a node's callbacks; its results are delivered between callbacks."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar

Item = TypeVar("Item", bound=Any)
Result = TypeVar("Result")


class _Guard(Protocol):
    def trigger(self) -> None: ...


class LatestWorker(Generic[Item, Result]):
    """Works on the newest item that was submitted; older ones that have not begun are skipped.

    Items are compared with each other: the newer one is the greater.

    Parameters
    ----------
    make_guard
        Creates a condition that any thread may trigger and whose callback a node's executor runs, such as
        :meth:`~semcal_ros.nodes.common.endpoints.Endpoints.guard`.
    work
        Runs in its own thread; must not raise.
    on_result
        Called with each result, like any callback of the node.
    """

    def __init__(
        self,
        make_guard: Callable[[Callable[[], None]], _Guard],
        work: Callable[[Item], Result],
        on_result: Callable[[Result], None],
    ) -> None:
        self._work = work
        self._on_result = on_result
        self._lock = threading.Lock()
        self._waiting: Item | None = None
        self._results: deque[Result] = deque()
        self._busy = False
        self._guard = make_guard(self._hand_over)

    def submit(self, item: Item) -> None:
        """Submit an item; it is skipped if a newer one is waiting or arrives before the work begins."""
        with self._lock:
            self._waiting = item if self._waiting is None else max(self._waiting, item)
            if self._busy:
                return
            self._busy = True
        # A daemon: it holds nothing that must be finished before the process ends.
        threading.Thread(target=self._run, name="background", daemon=True).start()

    def _next(self) -> Item | None:
        with self._lock:
            item, self._waiting = self._waiting, None
            self._busy = item is not None
            return item

    def _run(self) -> None:
        while (item := self._next()) is not None:
            self._results.append(self._work(item))
            # The node may have ended meanwhile.
            with contextlib.suppress(RuntimeError):
                self._guard.trigger()

    def _hand_over(self) -> None:
        while self._results:
            self._on_result(self._results.popleft())
