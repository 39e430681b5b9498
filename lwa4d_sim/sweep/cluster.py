"""Workers on other computers: the workers of a running Dask scheduler, reached by its address."""

import logging
import re
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from queue import Empty, Queue
from typing import Any

from lwa4d_sim.documents import one_line
from lwa4d_sim.errors import SweepError
from lwa4d_sim.sweep.work import Task, check_versions, environment, work
from lwa4d_sim.sweep.workers import Done

_CONNECT = 6.0  # [s] a scheduler in reach answers within a fraction of one
_SILENCE = 6.0  # [s] without a connection after which the scheduler is taken for gone
_LOOK = 0.5  # [s] between two looks at the connection
# with the schemes that Dask knows; it takes seconds to find that anything else leads nowhere
_ADDRESS = re.compile(r"((tcp|tls|wss?|ucx)://)?[^\s/]+:\d{1,5}")
_AHEAD = 2  # tasks a thread: one to work on, one on its way


class Cluster:
    """The workers of a Dask scheduler. It retries a task by itself when a worker dies; see `allowed-failures` there.

    Args:
        address: of the scheduler, such as tcp://host:8786.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._client: Any = None
        self._going: dict[str, int] = {}
        self._ended: Queue[Any] = Queue()
        self._threads = 0

    @property
    def size(self) -> int:
        return max(1, self._threads)

    @property
    def room(self) -> int:
        return _AHEAD * self.size - len(self._going)

    def submit(self, ticket: int, task: Task) -> None:
        # impure: the scheduler must not remember the answers of another sweep
        future = self._client.submit(work, task, pure=False)
        self._going[future.key] = ticket
        future.add_done_callback(self._ended.put)

    def finished(self) -> list[Done]:
        last = time.monotonic()
        while True:
            try:
                return [self._done(self._ended.get(timeout=_LOOK))]
            except Empty:
                now = time.monotonic()
                if self._connected():
                    last = now
                    self._count()
                elif now - last > _SILENCE:
                    raise self._gone() from None

    def _done(self, future: Any) -> Done:
        ticket = self._going.pop(future.key)
        if future.status == "finished":
            return Done(ticket, future.result())
        if future.status != "error":  # cancelled or lost, with the connection
            raise self._gone()
        error = future.exception()
        if isinstance(error, SweepError):
            raise error
        if type(error).__name__ == "KilledWorker":
            return Done(ticket, None)
        raise SweepError(one_line(f"cluster {self._address}: a worker failed with {type(error).__name__}: {error}"))

    def _connected(self) -> bool:
        comm = self._client.scheduler_comm
        return self._client.status == "running" and comm is not None and not comm.closed()

    def _count(self) -> None:
        info = self._client.scheduler_info(n_workers=-1)["workers"]
        self._threads = sum(worker["nthreads"] for worker in info.values())

    def _gone(self) -> SweepError:
        kept = "finished parts are kept, the same command goes on from there"
        return SweepError(f"cluster {self._address}: the scheduler is gone; {kept}")

    def __enter__(self) -> "Cluster":
        try:
            from distributed import Client
        except ImportError as error:
            raise SweepError("--cluster needs the package 'distributed': pip install 'lwa4d_sim[cluster]'") from error
        if not _ADDRESS.fullmatch(self._address):
            raise SweepError(f"cluster {self._address}: must be an address such as tcp://host:8786")
        _hush()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # versions are compared below, and a difference is an error
                self._client = _within(
                    _CONNECT + 1.0, lambda: Client(self._address, timeout=_CONNECT, set_as_default=False)
                )
        except (OSError, ValueError, TimeoutError) as error:
            raise SweepError(
                f"cluster {self._address}: no Dask scheduler answers there within {_CONNECT:g} s"
            ) from error
        try:
            self._check()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _check(self) -> None:
        """Look at the workers that are there; those that come later look at themselves.

        Raises:
            SweepError: there are none, or one of them has other software.
        """
        self._count()
        if not self._threads:
            raise SweepError(f"cluster {self._address}: has no workers; start some: dask worker {self._address}")
        found = self._client.run(environment, on_error="return")
        for worker, versions in found.items():
            if not isinstance(versions, Mapping):
                raise SweepError(one_line(f"worker {worker} cannot import lwa4d_sim: {versions}; install it there"))
            check_versions(environment(), f"worker {worker}", versions)

    def __exit__(self, *why: Any) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._client.close(timeout=2)


def _within(seconds: float, make: Callable[[], Any]) -> Any:
    """What ``make`` makes; Dask's own limit does not hold where something else than Dask listens.

    Raises:
        TimeoutError: it takes longer.
    """
    made: Queue[tuple[Any, Exception | None]] = Queue()

    def attempt() -> None:
        try:
            made.put((make(), None))
        except Exception as error:
            made.put((None, error))

    threading.Thread(target=attempt, daemon=True).start()
    try:
        value, error = made.get(timeout=seconds)
    except Empty:
        raise TimeoutError from None
    if error is not None:
        raise error
    return value


def _hush() -> None:
    """Keep Dask from telling at length what one line says; importing it gives each of its loggers a level."""
    for name in list(logging.Logger.manager.loggerDict):
        if name.split(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
