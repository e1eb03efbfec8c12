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

from setuptools import setup

setup(
    name="bead_tracker",
    version="0.1.0",
    packages=["bead_tracker"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/bead_tracker"]),
        ("share/bead_tracker", ["package.xml"]),
        ("share/bead_tracker/launch", ["launch/bead_launch.py"]),
    ],
    entry_points={
        "console_scripts": ["bead = bead_tracker.bead:main"],
        "semcal_ros.consumers": ["bead = bead_tracker.bead:on_frame"],
    },
)
