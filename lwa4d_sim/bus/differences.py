"""What a bus has that a scenario does not expect, and the other way round."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from canopen.objectdictionary import ObjectDictionary

from lwa4d_sim.bus.checks import arm_streams
from lwa4d_sim.bus.commission import EVENT, SYNCHRONOUS
from lwa4d_sim.bus.dictionary import drive_dictionary
from lwa4d_sim.bus.master import Plan
from lwa4d_sim.bus.response import utilisation
from lwa4d_sim.bus.stations import LAYOUTS
from lwa4d_sim.bus.survey import NodeFound, Pdo, Survey, Surveyor
from lwa4d_sim.interfaces import NS_PER_S

DRIVE = 402  # device profile number in the low half of 1000 (CiA 402-1)
PERIOD_TOLERANCE = 0.05  # share by which the SYNC period seen may differ (assumed)


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference.

    Attributes:
        nodes: that it is about; none = the bus as a whole.
        text: what differs.
        rewritten: the scenario's master sets it right when it starts.
    """

    nodes: tuple[int, ...]
    text: str
    rewritten: bool = False

    def __str__(self) -> str:
        if not self.nodes:
            return self.text
        return f"node{'s' if len(self.nodes) > 1 else ''} {', '.join(map(str, self.nodes))}: {self.text}"


def differences(survey: Survey, plan: Plan, bit_rate: int | None) -> list[Difference]:
    """What does not fit; equal words about several nodes are said once.

    Args:
        survey: of the bus.
        plan: what the scenario's master would set up.
        bit_rate: [bit/s].
    """
    found = {node.node: node for node in survey.nodes}
    expected = [joint.node for joint in plan.joints]
    said: dict[tuple[str, bool], list[int]] = {}
    for node in sorted({*found, *expected}):
        texts: Iterable[tuple[str, bool]]
        if node not in found:
            texts = [("is missing", False)]
        elif node not in expected:
            texts = [("is not in the scenario", False)]
        else:
            texts = _of_node(found[node], plan)
        for text in texts:
            said.setdefault(text, []).append(node)
    of_nodes = [Difference(tuple(nodes), text, rewritten) for (text, rewritten), nodes in said.items()]
    return of_nodes + [Difference((), text) for text in _of_bus(survey, plan, bit_rate)]


def beside_sheet(surveyor: Surveyor, survey: Survey, sheet: ObjectDictionary) -> list[Difference]:
    """What the answering nodes lack of a data sheet."""
    said: dict[str, list[int]] = {}
    for node in (found.node for found in survey.nodes if found.answers == 1):
        lacking = surveyor.lacking(node, sheet)
        if lacking:
            said.setdefault(f"lacks of the data sheet: {' '.join(lacking)}", []).append(node)
    return [Difference(tuple(nodes), text) for text, nodes in said.items()]


def _of_bus(survey: Survey, plan: Plan, bit_rate: int | None) -> Iterator[str]:
    if survey.sync_period is not None:
        yield "a SYNC producer is at work; the scenario's master would be the second"
        asked = plan.period / NS_PER_S
        if abs(survey.sync_period - asked) > PERIOD_TOLERANCE * asked:
            yield f"SYNC comes every {1e3 * survey.sync_period:.3f} ms, in the scenario every {1e3 * asked:g} ms"
    if bit_rate is not None:
        # with a master at work, what was heard is its cycle and not something besides the scenario's
        others = (survey.load or 0.0) if survey.sync_period is None else 0.0
        load = utilisation(arm_streams(plan), bit_rate) + others
        if load > 1:
            yield f"the scenario's frames and those heard take up to {100 * load:.0f} % of {bit_rate} bit/s"


def _of_node(found: NodeFound, plan: Plan) -> Iterator[tuple[str, bool]]:
    if found.answers > 1:
        yield f"{found.answers} answers to one request: two nodes have this id", False
    elif not found.answers:
        yield "does not answer requests", False
    elif found.device is None or found.device & 0xFFFF != DRIVE:
        yield f"is no drive: device type {_hex(found.device, 8)}, expected profile {DRIVE}", False
    else:
        for text in _of_drive(found, plan):
            yield text, False
        for text in _of_pdos(found, plan):
            yield text, True


def _of_drive(found: NodeFound, plan: Plan) -> Iterator[str]:
    layout = LAYOUTS[plan.profile]
    dictionary = drive_dictionary(
        plan.profile, found.node, next(joint for joint in plan.joints if joint.node == found.node)
    )
    known, modes = _hex(found.modes, 2), dictionary[0x6502, 0]
    if found.modes is None or not found.modes >> layout.bit & 1:
        yield f"does not support mode {layout.mode} of the profile '{plan.profile}'; its modes are {known}"
    elif found.modes != modes:
        yield f"supports the modes {known}, a drive of the profile '{plan.profile}' {_hex(modes, 2)}"
    for k, (end, limit) in enumerate(zip(("lower", "upper"), found.limits, strict=True), start=1):
        if limit != dictionary[0x607D, k]:
            yield f"{end} position limit (607D:{k}) is {limit} mdeg, in the scenario {dictionary[0x607D, k]} mdeg"
    pdos = {pdo.name: pdo for pdo in found.pdos}
    for kind, maps in (("RPDO", layout.receive), ("TPDO", layout.transmit)):
        for i in range(1, 5):
            pdo = pdos.get(f"{kind}{i}")
            if i <= len(maps) and pdo is None:
                yield f"has no {kind}{i}"
            elif i > len(maps) and pdo is not None and pdo.used:
                yield f"{pdo.name} is in use ({mapped(pdo)}), and the scenario's master leaves it so"


def _of_pdos(found: NodeFound, plan: Plan) -> Iterator[str]:
    layout = LAYOUTS[plan.profile]
    wanted = {f"RPDO{i}": items for i, items in enumerate(layout.receive, start=1)}
    wanted |= {f"TPDO{i}": items for i, items in enumerate(layout.transmit, start=1)}
    for pdo in found.pdos:
        entries = tuple((index, sub, bits) for index, sub, bits, _ in wanted.get(pdo.name, ()))
        kind = EVENT if plan.immediate and pdo.name.startswith("R") else SYNCHRONOUS
        if entries and (pdo.entries != entries or pdo.kind != kind):
            asked = " ".join(map(_entry, entries))
            yield f"{pdo.name} maps {mapped(pdo) or 'nothing'}, type {pdo.kind}; in the scenario {asked}, type {kind}"


def mapped(pdo: Pdo) -> str:
    """Contents of a PDO in short: 6040/16 60C1:1/32."""
    return " ".join(map(_entry, pdo.entries))


def _entry(entry: tuple[int, int, int]) -> str:
    index, sub, bits = entry
    return f"{index:04X}{f':{sub}' if sub else ''}/{bits}"


def _hex(value: int | None, digits: int) -> str:
    return "unknown" if value is None else f"0x{value:0{digits}X}"
