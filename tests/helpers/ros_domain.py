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

"""ROS domains for tests, each held by one process at a time."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path

# Ids above 101 would use ports from the range that Linux hands out to other programs.
_DOMAIN_IDS = range(1, 102)


def claim_domain() -> tuple[int, int]:
    """A ROS domain id that no other test process on this machine holds, and the open lock file.

    The lock lives as long as the process, however that ends.
    """
    start = os.getpid() % len(_DOMAIN_IDS)
    for domain_id in [*_DOMAIN_IDS[start:], *_DOMAIN_IDS[:start]]:
        path = Path(tempfile.gettempdir()) / f"semcal-ros-domain-{os.getuid()}-{domain_id}.lock"
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        return domain_id, lock
    raise RuntimeError("all ROS domain ids are in use by other test runs; wait for them to end")
