"""Workers on this computer: processes of one thread each, each with one task at a time, any of which may be killed."""

import multiprocessing
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, NamedTuple, Protocol

from lwa4d_sim.batch import deaf
from lwa4d_sim.errors import SweepError
from lwa4d_sim.sweep.work import Answer, Task, work

_STILLBORN = 3  # processes in a row that end before they begin
_CANNOT_START = (
    "worker processes end as soon as they start; a script of your own must call this under if __name__ == '__main__'"
)


class Done(NamedTuple):
    """What became of a task: its ticket, and its answer, or None where the worker died."""

    ticket: int
    answer: Answer | None


class Workers(Protocol):
    """Some place where tasks are worked on."""

    @property
    def size(self) -> int:
        """Tasks worked on at the same time."""
        ...

    @property
    def room(self) -> int:
        """Tasks that may be handed in now."""
        ...

    def submit(self, ticket: int, task: Task) -> None:
        """Hand in a task."""
        ...

    def finished(self) -> list[Done]:
        """Wait until something has become of some task.

        Raises:
            SweepError: nothing can become of any.
        """
        ...

    def __enter__(self) -> "Workers":
        """Ready for tasks."""
        ...

    def __exit__(self, *why: Any) -> None:
        """Drop what is not finished."""
        ...


class Processes:
    """``size`` processes of this computer; a killed one is replaced at the next task."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._idle: list[_Process] = []
        self._busy: dict[_Process, int] = {}
        self._stillborn = 0

    @property
    def size(self) -> int:
        return self._size

    @property
    def room(self) -> int:
        return self._size - len(self._busy)

    def submit(self, ticket: int, task: Task) -> None:
        process = self._idle.pop() if self._idle else _Process()
        process.send(task)
        self._busy[process] = ticket

    def finished(self) -> list[Done]:
        done: list[Done] = []
        while not done:
            ready = set(wait([process.pipe for process in self._busy]))
            for process in [process for process in self._busy if process.pipe in ready]:
                self._hear(process, done)
        return done

    def _hear(self, process: "_Process", done: list[Done]) -> None:
        """Take what a process says; its death is a word as well."""
        try:
            answer = process.pipe.recv()
        except (EOFError, OSError):  # a killed process closes its end
            self._stillborn += not process.began
            done.append(Done(self._busy.pop(process), None))
            process.end()
            if self._stillborn == _STILLBORN:
                raise SweepError(_CANNOT_START) from None
            return
        if not process.began:
            process.began, self._stillborn = True, 0
            return
        self._idle.append(process)
        ticket = self._busy.pop(process)
        if isinstance(answer, SweepError):
            raise answer
        done.append(Done(ticket, answer))

    def __enter__(self) -> "Processes":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # a task's results are here or lost; a process writes nothing, so that it can end at once
        for process in [*self._idle, *self._busy]:
            process.end()
        self._idle, self._busy = [], {}


class _Process:
    """One worker process and this end of its pipe."""

    def __init__(self) -> None:
        # spawned, because a forked copy of a process with running threads may hang
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.began = False
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with deaf():
            self._process.start()
        theirs.close()  # so that its death closes the pipe

    def send(self, task: Task) -> None:
        with suppress(OSError):  # it died while idle, which is heard of soon enough
            self.pipe.send(task)

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _serve(pipe: "Connection[Any, Any]") -> None:
    """Work until the other end is closed, which the death of the other process does as well."""
    try:
        pipe.send("began")
        while True:
            task = pipe.recv()
            try:
                answer: Any = work(task)
            except SweepError as error:
                answer = error
            pipe.send(answer)
    except (EOFError, OSError):
        return
