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

"""Cases of a test of which `make test` runs some, and `make test-long` the others."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest

__all__ = ["long_but"]


def long_but(quick: Callable[[Any], bool], cases: Iterable[Any]) -> list[Any]:
    """The cases for ``parametrize``, those that are not ``quick`` with the marker ``long``."""
    return [case if quick(case) else pytest.param(case, marks=pytest.mark.long) for case in cases]
