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

"""The dictionary of limited size."""

from __future__ import annotations

import pickle

from semcal_ros.core.caches import LruCache


def test_the_least_recently_used_is_forgotten() -> None:
    cache: LruCache[str, int] = LruCache(2)
    cache.put("a", 1)
    cache.put("b", 2)
    assert cache.get("a", 0) == 1
    cache.put("c", 3)
    assert "b" not in cache
    assert (cache.get("a", 0), cache.get("b", 0), cache.get("c", 0)) == (1, 0, 3)
    # To put one again makes it the latest, too.
    cache.put("a", 4)
    cache.put("d", 5)
    assert "c" not in cache
    assert cache.get("a", 0) == 4


def test_a_value_is_computed_once() -> None:
    cache: LruCache[int, list[int]] = LruCache(1)
    first = cache.get_or_compute(1, lambda: [1])
    assert cache.get_or_compute(1, lambda: [2]) is first
    assert cache.get_or_compute(2, lambda: [3]) == [3]
    assert 1 not in cache


def test_a_cache_goes_to_another_process() -> None:
    cache: LruCache[int, int] = LruCache(3)
    cache.put(1, 2)
    assert pickle.loads(pickle.dumps(cache)).get(1, 0) == 2
