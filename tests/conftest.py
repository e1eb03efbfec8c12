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

"""What every test gets: a ROS domain of its own, no traces in the home folder, the recordings."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import tempfile
import warnings
from pathlib import Path

import hypothesis
import pytest

from tests.helpers.ros_domain import claim_domain

# Machines that run tests are shared, so a slow example is no failure. An ordinary run tries the same
# examples every time; `make fuzz` tries others, from the seed that it prints.
hypothesis.settings.register_profile("semcal", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.register_profile("explore", deadline=None, print_blob=True, max_examples=500)
hypothesis.settings.load_profile("explore" if "SEMCAL_FUZZ_CASES" in os.environ else "semcal")


def _share() -> None:
    """One folder for all processes of this run (``tests/helpers/made_once.py``): the first makes it."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        shared = tempfile.mkdtemp(prefix="semcal-tests-")
        atexit.register(shutil.rmtree, shared, ignore_errors=True)
        os.environ["SEMCAL_TESTS_SHARED"] = shared


def _isolate() -> int:
    _share()
    # A shell ignores SIGINT for a job in the background, and what the tests start would inherit that.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    domain_id, lock = claim_domain()
    logs = tempfile.mkdtemp(prefix="semcal-ros-log-")
    atexit.register(shutil.rmtree, logs, ignore_errors=True)
    os.environ.update(
        ROS_DOMAIN_ID=str(domain_id),
        ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
        ROS_LOG_DIR=logs,
        MPLBACKEND="Agg",
        # As the executables do: threads of OpenBLAS would only wait for each other.
        OPENBLAS_NUM_THREADS="1",
        # The tests share the processors already. Processes for one recording would each import all again,
        # measured: 3.6 s of processor for two; the test that needs several says so.
        LOKY_MAX_CPU_COUNT="1",
    )
    # Other people's settings must not decide over the outcome of a test.
    for name in (
        "ROS_NAMESPACE",
        "ROS_STATIC_PEERS",
        "RMW_IMPLEMENTATION",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        "FASTDDS_DEFAULT_PROFILES_FILE",
        "FASTDDS_BUILTIN_TRANSPORTS",
        "ROS_LOCALHOST_ONLY",
        "ROS_SECURITY_ENABLE",
        "ROS_SECURITY_STRATEGY",
        "ROS_SECURITY_KEYSTORE",
        "ROS_SECURITY_ENCLAVE_OVERRIDE",
    ):
        os.environ.pop(name, None)
    # As the executables do. Imported here: numpy must not be loaded before the variables above are set.
    from semcal_ros.middleware import add_environment_prefix

    add_environment_prefix()
    return lock


# Here and not in a fixture: the environment must be set before a test module imports rclpy.
_DOMAIN_LOCK = _isolate()


# rclpy imports a parser whose dependency uses modules that Python 3.11 deprecates; only the import is excused.
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    import rosidl_generator_py  # noqa: F401


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """Folder of the reference recordings, named by SEMCAL_REFERENCE_DATA."""
    value = os.environ.get("SEMCAL_REFERENCE_DATA")
    if not value:
        pytest.skip("SEMCAL_REFERENCE_DATA is not set: no reference recordings")
    path = Path(value)
    assert path.is_dir(), f"SEMCAL_REFERENCE_DATA is {value!r}, which is not a folder"
    return path
