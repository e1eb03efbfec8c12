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

"""The bridge works where no ROS package is installed."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        ros = ("rclpy", "rosbags", "ament_index_python")
        if top in ros or top.endswith(("_msgs", "_interfaces")):
            raise ImportError("blocked " + name)
        return None

sys.meta_path.insert(0, Blocker())
import importlib
import pkgutil
import semcal_ros.bridge

for module in pkgutil.iter_modules(semcal_ros.bridge.__path__, "semcal_ros.bridge."):
    importlib.import_module(module.name)
from semcal_ros.config.config import load_config

assert load_config("generic").name == "generic"
"""


def test_imports_without_ros_and_without_rosbags() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
