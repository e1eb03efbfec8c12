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

"""What is expensive is made once in a run, however many of its processes ask for it."""

from __future__ import annotations

import fcntl
import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

__all__ = ["folder_once", "made_once"]

T = TypeVar("T")


def made_once(name: str, make: Callable[[], T]) -> T:
    """The value of ``make()``, from whichever process of this run came first.

    The folder is that of this run (``tests/conftest.py``), so nothing of an older source can come
    from it. A failure is not kept: the next one tries again.
    """
    path = Path(os.environ["SEMCAL_TESTS_SHARED"]) / f"{name}.pickle"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            made = pickle.dumps(make())
            part = path.with_suffix(".part")
            part.write_bytes(made)
            part.replace(path)
    # Each gets a copy of its own, also the first, so that all see the same.
    value: T = pickle.loads(path.read_bytes())
    return value


def folder_once(name: str, fill: Callable[[Path], None]) -> Path:
    """A folder that ``fill`` has filled, the same for all processes of this run."""

    def filled() -> str:
        folder = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=os.environ["SEMCAL_TESTS_SHARED"]))
        fill(folder)
        return str(folder)

    return Path(made_once(name, filled))
