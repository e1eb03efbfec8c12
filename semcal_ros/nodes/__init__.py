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

"""The ROS 2 executables: thin nodes around :mod:`semcal_ros.core` and :mod:`semcal_ros.bridge`."""

from __future__ import annotations

import os

__all__: list[str] = []

# Before numpy is imported. The matrices here are small, and OpenBLAS's threads wait for each other
# in busy loops: beside other nodes that costs several times the work itself.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
