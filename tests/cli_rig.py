"""The program called in this process, as the shell would call it."""

import sys
from collections.abc import Callable
from typing import NamedTuple

import pytest

from lwa4d_sim import cli


class Result(NamedTuple):
    code: int
    out: str
    err: str


Call = Callable[..., Result]


def caller(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: str) -> Call:
    """Runs `lwa4d-sim COMMAND` with the arguments it is called with."""

    def run(*arguments: object) -> Result:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["lwa4d-sim", command, *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return Result(int(str(end.value.code)), *capfd.readouterr())

    return run
