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

"""Whether a topic that a node lives on has one source, and whether that sends."""

from __future__ import annotations

from collections.abc import Sequence

# A person who starts things one after the other is not told at once; who waits for an image is told soon.
_SILENT_S = 5.0
# Fast DDS forgets a process that was killed after 20 s; until then its successor of the same name is not alone.
_FORGOTTEN_S = 30.0


class SourceWatch:
    """Watches one topic; :meth:`check` says what has changed.

    Parameters
    ----------
    what
        What comes on the topic, one word, such as ``image``.
    topic
        Its name, for messages.
    streams
        Whether silence counts at any time; otherwise only before the first message.
    now_s
        The time at the start, s, on a clock that does not stand still.
    """

    def __init__(self, what: str, topic: str, *, streams: bool, now_s: float) -> None:
        self._what = what
        self._topic = topic
        self._streams = streams
        self._received = 0
        self._heard_s = now_s
        self._silent = False
        self._namesakes_since_s: float | None = None
        self.rivals = ""

    def check(
        self, now_s: float, received: int, publishers: Sequence[str]
    ) -> tuple[list[str], list[str]]:
        """Return new warnings and new good news, given the messages so far and the names of all publishers.

        The name of a publisher that is not known is empty.
        """
        warnings, news = self._check_silence(now_s, received, len(publishers))
        before, self.rivals = self.rivals, self.describe_rivals(now_s, publishers)
        if self.rivals and not before:
            warnings.append(f"{self.rivals}: what they publish is mixed; end all but one")
        elif before and not self.rivals:
            news.append(f"one publisher on {self._topic} again")
        return warnings, news

    def _check_silence(
        self, now_s: float, received: int, publishers: int
    ) -> tuple[list[str], list[str]]:
        if received != self._received:
            silence_s, self._heard_s, self._received = now_s - self._heard_s, now_s, received
            if self._silent:
                self._silent = False
                return [], [f"{self._what} on {self._topic} after {silence_s:.0f} s"]
        expected = self._streams or received == 0
        if expected and not self._silent and now_s - self._heard_s >= _SILENT_S:
            self._silent = True
            why = "nobody publishes there" if publishers == 0 else f"{publishers} publish there"
            return [
                f"no {self._what} on {self._topic} for {_SILENT_S:.0f} s: {why};"
                " check that the microscope's driver runs, and the names of the topics in config"
            ], []
        return [], []

    def describe_rivals(self, now_s: float, publishers: Sequence[str]) -> str:
        """Return, in a few words, which publishers are one too many; empty if none is.

        Two of one name count only after a while: one of them may be a process that was killed. So does one whose name
        is empty, because it is not known yet: it may be the successor.
        """
        names = sorted(set(publishers) - {""})
        count = len(publishers)
        if count <= max(len(names), 1):
            self._namesakes_since_s = None
        elif self._namesakes_since_s is None:
            self._namesakes_since_s = now_s
        lasting = (
            self._namesakes_since_s is not None and now_s - self._namesakes_since_s >= _FORGOTTEN_S
        )
        if len(names) > 1 or lasting:
            if "" in publishers:
                listed = ", ".join([*names, "without a name"])
            else:
                listed = ", ".join(names if len(names) > 1 else [f"{names[0]} {count} times"])
            return f"{count} publishers on {self._topic}: {listed}"
        return ""
