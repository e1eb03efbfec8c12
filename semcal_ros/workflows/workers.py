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

"""Where the work of a command is done: in this process, on all cores, or on a Dask cluster.

Work is shared in the order of its items, and only a few of them are in memory at a time, however
many there are. What comes back is the same to the last bit wherever it was computed, as long as
the versions are the same, which is checked, and the processors round alike.

On a cluster the work goes to the executor of `distributed`, not to joblib's own Dask backend. That one
places every argument of more than 1 kB on a worker before the task that needs it, so that the images on a
worker that is killed are lost and the command ends with a ``FutureCancelledError`` (joblib 1.5, a worker of two
killed after 15 of 40 tasks; with the executor all 40 results came). Nor can it be told how many bytes may
be under way.
"""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from contextlib import ExitStack, contextmanager
from itertools import starmap
from typing import Any, TypeVar

import cv2
import numpy as np
import scipy
from joblib import Parallel, delayed

import semcal_ros
from semcal_ros.core.errors import InvalidValueError, SemcalError

Result = TypeVar("Result")

# Items under way for each core of a cluster: one that is computed, one that waits beside it, and
# as many results until the first of them is there.
_ITEMS_PER_CORE = 4
# Bytes of the arrays under way; results are of the same order.
_BYTES_UNDER_WAY = 256 << 20
# A scheduler on the local network answers within milliseconds; workers take seconds to import.
_SCHEDULER_TIMEOUT_S = 10
_WORKERS_TIMEOUT_S = 60


class Workers:
    """Processes that compute; made by :func:`open_workers`.

    Parameters
    ----------
    processes
        Number of processes of this machine; 1 computes in this one.
    executor
        Of a cluster, instead.
    cores
        Number of cores of the cluster.
    """

    def __init__(self, processes: int = 1, executor: Executor | None = None, cores: int = 1):
        self._processes = processes
        self._executor = executor
        self._limit = _ITEMS_PER_CORE * max(cores, 1)

    @property
    def elsewhere(self) -> bool:
        """Whether the work is done outside this machine's memory, on a cluster."""
        return self._executor is not None

    def starmap(
        self, function: Callable[..., Result], items: Iterable[Sequence[Any]]
    ) -> Iterator[Result]:
        """Results of ``function(*item)`` in the order of the items, which are taken a few at a time.

        Parameters
        ----------
        function
            Of a module, so that another process can import it.
        items
            Arguments, which are sent to the process.

        Raises
        ------
        SemcalError
            If the cluster fails; whatever ``function`` raises is raised here.
        """
        if self._executor is not None:
            return self._share(self._executor, function, items)
        if self._processes == 1:
            return starmap(function, items)
        work = Parallel(n_jobs=self._processes, return_as="generator")
        return iter(work(delayed(function)(*item) for item in items))

    def _share(
        self,
        executor: Executor,
        function: Callable[..., Result],
        items: Iterable[Sequence[Any]],
    ) -> Iterator[Result]:
        waiting: deque[tuple[Future[Result], int]] = deque()
        under_way = 0
        try:
            for item in items:
                size = sum(count_bytes(argument) for argument in item)
                while waiting and (
                    len(waiting) >= self._limit or under_way + size > _BYTES_UNDER_WAY
                ):
                    under_way -= waiting[0][1]
                    yield _result(waiting.popleft()[0])
                waiting.append((executor.submit(function, *item), size))
                under_way += size
            while waiting:
                yield _result(waiting.popleft()[0])
        finally:
            for future, _ in waiting:
                future.cancel()


def count_bytes(argument: Any) -> int:
    """Bytes of an array, or of those in a list or tuple of any depth."""
    if isinstance(argument, (list, tuple)):
        return sum(count_bytes(part) for part in argument)
    return int(getattr(argument, "nbytes", 0))


def _result(future: Future[Result]) -> Result:
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        raise SemcalError(
            f"several Dask workers died one after the other over the same work ({error.task})",
            expected="workers that stay alive",
            do="give them more memory, or fewer threads each",
        ) from error
    except CancelledError as error:
        raise SemcalError(
            "the Dask scheduler is gone, and the results with it",
            expected="a scheduler that stays",
            do="start it and its workers again, then repeat the command",
        ) from error


@contextmanager
def open_workers(dask: str | None = None, *, processes: int = 1) -> Iterator[Workers]:
    """Workers for one command.

    Parameters
    ----------
    dask
        Address of a Dask scheduler, such as ``tcp://host:8786``; None for this machine.
    processes
        Number of processes without a cluster; 1 computes in this one.

    Raises
    ------
    SemcalError
        If ``distributed`` is not installed; there is no scheduler, or it has no workers; or
        a worker has other versions of what computes.
    """
    if dask is None:
        yield Workers(processes)
        return
    if not re.fullmatch(r"(\w+://)?\S+:\d+", dask):
        raise InvalidValueError(
            f"{dask!r} as the address of a Dask scheduler", expected="such as tcp://host:8786"
        )
    try:
        import dask as dask_library
        from distributed import Client
    except ImportError as error:
        raise SemcalError(
            f"work for Dask at {dask}, but the package distributed is missing",
            expected="the extra `dask`",
            do="pip install 'semcal_ros[dask]', or leave --dask out",
        ) from error
    with ExitStack() as stack, _silence("distributed", "tornado.application", "asyncio"):
        # A task carries its images with it: so it can begin anew when its worker is gone.
        stack.enter_context(
            dask_library.config.set({"distributed.admin.large-graph-warning-threshold": "1GiB"})
        )
        try:
            client = Client(dask, timeout=_SCHEDULER_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InvalidValueError(
                f"no Dask scheduler at {dask}",
                expected="the address of one, such as tcp://host:8786",
                do="start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
            ) from error
        stack.enter_context(client)
        cores = _check_workers(client, dask)
        yield Workers(executor=client.get_executor(pure=False), cores=cores)


@contextmanager
def _silence(*names: str) -> Iterator[None]:
    """Leave out what libraries log, with tracebacks, of workers that come and go."""
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL + 1)
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def _check_workers(client: Any, dask: str) -> int:
    """Number of cores of the cluster; refuses one whose workers have other versions."""
    try:
        client.wait_for_workers(1, timeout=_WORKERS_TIMEOUT_S)
    except TimeoutError as error:
        raise InvalidValueError(
            f"the Dask scheduler at {dask} has no workers",
            expected="at least one",
            do=f"start some with `dask worker {dask} --nthreads 1`",
        ) from error
    here = describe_versions()
    for address, there in client.run(describe_versions, on_error="return").items():
        if there == here:
            continue
        seen = there if isinstance(there, Exception) else _list_differences(there, here)
        raise InvalidValueError(
            f"the Dask worker {address} would compute something else: {seen}",
            expected="the same versions everywhere, for the same results",
            do="install the versions of requirements/base.txt on it",
        )
    return sum(client.ncores().values())


def describe_versions() -> dict[str, str]:
    """Versions of this package and of the libraries that compute, which all workers must share."""
    return {
        "semcal_ros": semcal_ros.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "OpenCV": cv2.__version__,
    }


def _list_differences(there: dict[str, str], here: dict[str, str]) -> str:
    return ", ".join(
        f"{name} {there.get(name)} (here {here[name]})"
        for name in here
        if there.get(name) != here[name]
    )
