"""What `bus check` has found, as tables for a terminal."""

import sys
from collections.abc import Sequence
from typing import Any

from lwa4d_sim.bus.cia402 import state_of
from lwa4d_sim.bus.differences import Difference, mapped
from lwa4d_sim.bus.survey import NodeFound, Pdo, Survey

_NMT = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}  # CiA 301, table 39
_MODES = ("PP", "VL", "PV", "PT", "", "HM", "IP", "CSP", "CSV", "CST")  # bits of 6502 (CiA 402-2)
_PIPE_WIDTH = 160  # columns where nobody watches


def print_survey(survey: Survey, said: Sequence[Difference]) -> None:
    """All of it on stdout, with what differs from a scenario."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH, highlight=False, markup=False)
    nodes = Table(
        "node", "name", "firmware", "device", "vendor product revision serial", "NMT", box=None, pad_edge=False
    )
    drives = Table(
        "node", "modes", "mode", "state", "position [mdeg]", "limits [mdeg]", "errors", box=None, pad_edge=False
    )
    pdos = Table("node", "PDO", "COB-ID", "type", "maps", box=None, pad_edge=False)
    for found in survey.nodes:
        node = str(found.node) + (" (twice)" if found.answers > 1 else "")
        identity = " ".join(_text(number) for number in found.identity)
        nodes.add_row(node, _text(found.name), _text(found.firmware), _hex(found.device), identity, _nmt(found))
        if found.answers != 1:
            continue
        limits = " to ".join(map(_text, found.limits))
        drives.add_row(
            node, _modes(found), *map(_text, (found.mode, _state(found), found.position)), limits, _errors(found)
        )
        for pdo in found.pdos:
            if pdo.entries or pdo.used:
                pdos.add_row(node, pdo.name, _cob_id(pdo), str(pdo.kind), mapped(pdo))
    for table in (nodes, drives, pdos):
        console.print(table)
        console.print()
    console.print(_traffic(survey))
    for title, rewritten in (("differs:", False), ("differs, and the master writes it when it starts:", True)):
        lines = [f"  {each}" for each in said if each.rewritten == rewritten]
        if lines:
            console.print("\n".join([title, *lines]), soft_wrap=True)


def _traffic(survey: Survey) -> str:
    load = "" if survey.load is None else f", load {100 * survey.load:.1f} %"
    sync = "no SYNC"
    if survey.sync_period is not None and survey.sync_jitter is not None:
        sync = f"SYNC every {1e3 * survey.sync_period:.3f} ms, up to {1e3 * survey.sync_jitter:.3f} ms off"
    errors = f", {survey.error_frames} error frames" if survey.error_frames else ""
    return f"heard in {survey.seconds:.1f} s: {survey.frames} frames{load}{errors}; {sync}"


def _text(value: Any) -> str:
    return "-" if value is None else str(value)


def _hex(value: int | None) -> str:
    return "-" if value is None else f"0x{value:X}"


def _nmt(found: NodeFound) -> str:
    told = "no heartbeat heard" if found.nmt is None else _NMT.get(found.nmt, str(found.nmt))
    return told + (f", every {found.heartbeat} ms" if found.heartbeat else "")


def _modes(found: NodeFound) -> str:
    if found.modes is None:
        return "-"
    names = [name for bit, name in enumerate(_MODES) if name and found.modes >> bit & 1]
    return f"{' '.join(names)} (0x{found.modes:X})"


def _state(found: NodeFound) -> str | None:
    if found.status is None:
        return None
    state = state_of(found.status)
    return f"{state.name.lower().replace('_', ' ') if state else 'unknown'} (0x{found.status:04X})"


def _errors(found: NodeFound) -> str:
    history = " ".join(f"{error & 0xFFFF:04X}" for error in found.errors)
    heard = " ".join(f"{code:04X}" for code in found.emergencies)
    parts = [f"register 0x{found.register:02X}" if found.register else "", history and f"history {history}"]
    parts.append(heard and f"heard {heard}")
    return ", ".join(part for part in parts if part) or "none"


def _cob_id(pdo: Pdo) -> str:
    return f"{pdo.cob_id & 0x7FF:03X}" + (" off" if pdo.cob_id >> 31 else "")
