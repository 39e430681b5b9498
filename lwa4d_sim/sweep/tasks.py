"""Carries tasks to workers and brings back the rows; whatever dies on the way is tried again."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

from lwa4d_sim.lockstep import group, pace
from lwa4d_sim.sweep.file import Point, Sweep
from lwa4d_sim.sweep.work import Answer, Task, environment, failure
from lwa4d_sim.sweep.workers import Workers

TRIES = 3  # before a run is given up
# Runs stepped together (assumed): few waste Python's time on every tick, many lose much when a worker dies and leave
# the others without work at the end. A task takes at most so long, its records at most so much memory.
MOST_TOGETHER, MOST_SECONDS, MOST_BYTES = 64, 30.0, 200_000_000
SHARES = 4  # tasks for each worker at least, so that all end at about the same time
FIRST = 8  # runs of the first task, which tells what a run costs


class Cost(NamedTuple):
    """What one run costs: time [s] and memory of its record [bytes]."""

    seconds: float
    record: int

    @staticmethod
    def of(answer: Answer) -> "Cost":
        """As found in a task."""
        return Cost(answer.seconds / len(answer.rows), answer.record)

    def together(self, runs: int, size: int) -> int:
        """How many runs to put into one task."""
        by_time = int(MOST_SECONDS / max(self.seconds, 1e-9))
        by_memory = MOST_BYTES // max(self.record, 1)
        return max(1, min(MOST_TOGETHER, by_time, by_memory, -(-runs // (SHARES * size))))


def task_of(sweep: Sweep, points: Sequence[Point]) -> Task:
    """The task of some runs."""
    scenario = sweep.scenario
    return Task(
        text=scenario.text,
        source=scenario.source,
        folder=str(scenario.folder.resolve()),
        overrides=scenario.overrides,
        variant=sweep.variant,
        metrics=sweep.metrics,
        runs=tuple((point.run, point.overrides) for point in points),
        versions=environment(),
    )


def groups(sweep: Sweep, points: Iterable[Point]) -> list[list[Point]]:
    """Points that may be stepped together, groups in order of their first, neighbours those that cost least together.

    Raises:
        ScenarioError: a point does not fit the scenario; names the axis at fault.
    """
    found: dict[str, list[tuple[tuple[float, float], Point]]] = {}
    for point in points:
        settings = sweep.check_point(point).variants[sweep.variant]
        found.setdefault(group(settings, point.run), []).append((pace(settings), point))
    return [[point for _, point in sorted(part, key=itemgetter(0))] for part in found.values()]


def cut(parts: Sequence[Sequence[Point]], size: int) -> list[Sequence[Point]]:
    """Groups in pieces of at most ``size`` runs."""
    return [part[k : k + size] for part in parts for k in range(0, len(part), size)]


class _Tried(NamedTuple):
    task: Task
    deaths: int


def work_off(tasks: Iterable[Task], workers: Workers) -> Iterator[Answer]:
    """Answers of all tasks as they come.

    A task whose worker died is tried again; at the last try each of its runs goes alone, so that one that kills its
    worker spoils no other.

    Raises:
        SweepError: the workers cannot be reached, or are not fit.
    """
    waiting = deque(_Tried(task, 0) for task in tasks)
    going: dict[int, _Tried] = {}
    ticket = 0
    while waiting or going:
        while waiting and workers.room > 0:
            going[ticket] = waiting.popleft()
            workers.submit(ticket, going[ticket].task)
            ticket += 1
        for done in workers.finished():
            tried = going.pop(done.ticket)
            if done.answer is not None:
                yield done.answer
                continue
            task, deaths = tried.task, tried.deaths + 1
            if deaths < TRIES - 1 or (len(task.runs) == 1 and deaths < TRIES):
                waiting.append(_Tried(task, deaths))
            elif deaths < TRIES:
                waiting.extend(_Tried(task.part(k, k + 1), deaths) for k in range(len(task.runs)))
            else:
                yield Answer(tuple(_killed(run) for run, _ in task.runs), 0.0, 0)


def _killed(run: int) -> Mapping[str, Any]:
    return failure(run, f"the process that ran it was killed {TRIES} times; is there enough memory?")
