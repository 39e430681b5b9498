"""The commands `lwa4d-sim bus ...`: one side of a scenario on a real bus, or the bus itself looked at."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from lwa4d_sim.console import Json, Out, Set, busy, override, progress, scenario_path
from lwa4d_sim.errors import BusError, ScenarioError

bus_app = typer.Typer(
    help="The arm or the controller on a CAN bus, and what the bus does.",
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_File = Annotated[str, typer.Argument(metavar="FILE", help="Scenario file, or name of a shipped one.")]
_Variant = Annotated[str | None, typer.Option(metavar="NAME", help="Variant; default the first with a CANopen loop.")]
_Interface = Annotated[str, typer.Option("-i", "--interface", metavar="I", help="python-can's name, e.g. socketcan.")]
_Channel = Annotated[str, typer.Option("-c", "--channel", metavar="C", help="Channel, e.g. can0 or 239.74.163.2.")]
_Log = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Log all frames; the ending says how: .log .asc .blf .csv .db .trc")
]
_Seconds = Annotated[float | None, typer.Option(metavar="S", min=0.0, help="End after so many seconds.")]
_Realtime = Annotated[
    bool, typer.Option("--realtime", help="Go ahead of all ordinary processes (SCHED_FIFO), where that is allowed.")
]


@bus_app.command()
def timing(
    file: _File,
    out: Out = Path("runs"),
    variant: _Variant = None,
    overrides: Set = None,
    cycles: Annotated[int, typer.Option(min=3, help="Cycles to look at.")] = 200,
    log: _Log = None,
    as_json: Json = False,
) -> None:
    """Show one cycle on the simulated bus, its load, and response times beside their worst case.

    Example: lwa4d-sim bus timing canopen7 -o runs
    """
    from lwa4d_sim.bus.build import bus_loop, canopen_run
    from lwa4d_sim.bus.frame_files import write
    from lwa4d_sim.bus_plots import draw_timing
    from lwa4d_sim.bus_timing import analyse, as_object, as_text
    from lwa4d_sim.frame_log import FrameLog

    blocks = _blocks(file, variant, overrides)
    loop = bus_loop(blocks.settings)
    if loop.bit_rate is None:
        raise ScenarioError(f"{blocks.scenario.source}: loop.bit_rate is null: frames take no time there")
    with blocks.about("loop"):
        simulation, ticks = canopen_run(blocks)
    total = min(cycles, blocks.timing.ticks)
    with progress("cycles", total, quiet=as_json) as advance:
        for _, _tick in zip(range(total), ticks, strict=False):
            advance()
    found = analyse(FrameLog.of(simulation.wire.frames), loop.bit_rate, blocks.timing.period, total)
    if log is not None:
        write(found.log, log)
    folder = out / blocks.scenario.name
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{blocks.scenario.name}, {blocks.variant}: one cycle at {loop.bit_rate // 1000} kbit/s"
    picture = draw_timing(found, title, loop.period, folder / "bus_timing.png")
    if as_json:
        print(json.dumps({**as_object(found), "picture": str(picture.path)}))
        return
    print(f"{as_text(found)}\npicture: {picture.path}")


@bus_app.command()
def serve(
    file: _File,
    interface: _Interface,
    channel: _Channel,
    variant: _Variant = None,
    overrides: Set = None,
    per_sync: Annotated[
        bool, typer.Option("--per-sync", help="Move the arm on by one period at each SYNC, not by the clock.")
    ] = False,
    log: _Log = None,
    seconds: _Seconds = None,
    realtime: _Realtime = False,
) -> None:
    """Put the simulated arm on a bus, as CANopen drives for anybody's master. Ctrl-C ends it.

    Example: lwa4d-sim bus serve canopen7_live -i udp_multicast -c 239.74.163.2
    """
    from lwa4d_sim.bus.build import bus_loop, served_arm
    from lwa4d_sim.bus.connect import connect, log_to
    from lwa4d_sim.bus.process import ARM, stoppable, undisturbed
    from lwa4d_sim.bus.serve import monotonic
    from lwa4d_sim.bus.serve import serve as keep_serving
    from lwa4d_sim.bus.survey import Surveyor

    blocks = _blocks(file, variant, overrides)
    bus = connect(interface, channel, bus_loop(blocks.settings).bit_rate)
    try:
        log_to(bus, log)
        with stoppable() as stop:
            arm = served_arm(blocks, bus, epoch=monotonic(), per_sync=per_sync)
            nodes = ", ".join(str(node.node_id) for node in arm.nodes)
            taken = Surveyor(bus, monotonic).answering(node.node_id for node in arm.nodes)
            if taken:
                raise BusError(f"{bus.channel_info} is in use: node {taken[0]} answers there already")
            end = math.inf if seconds is None else time.monotonic() + seconds
            with undisturbed(ARM if realtime else None):
                print(f"{blocks.settings.arm}: nodes {nodes} on {interface} {channel}; Ctrl-C ends", flush=True)
                keep_serving(arm, bus, monotonic, lambda: stop() or time.monotonic() > end)
        print(f"ended; brakes closed: {sum(drive.braked for drive in arm.drives)} of {len(arm.drives)}")
    finally:
        bus.shutdown()


@bus_app.command()
def drive(
    file: _File,
    interface: _Interface,
    channel: _Channel,
    variant: _Variant = None,
    overrides: Set = None,
    arm: Annotated[bool, typer.Option("--arm", help="Really enable the drives. Without it: a dry run.")] = False,
    torque: Annotated[
        float, typer.Option(metavar="SHARE", min=0.0, max=1.0, help="Share of the peak torques that may go out.")
    ] = 1.0,
    log: _Log = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="DIR", help="Write the record here.")] = None,
    seconds: _Seconds = None,
    realtime: _Realtime = False,
    as_json: Json = False,
) -> None:
    """Drive the arm on a bus with a scenario's controller. Without --arm, print the frames that would be sent.

    Example: lwa4d-sim bus drive canopen7_live -i udp_multicast -c 239.74.163.2 --arm
    """
    blocks = _blocks(file, variant, overrides)
    if not arm:
        _dry_run(blocks)
        return
    from lwa4d_sim.bus.build import bus_loop
    from lwa4d_sim.bus.connect import connect, log_to
    from lwa4d_sim.bus.live_run import drive_arm, report
    from lwa4d_sim.bus.process import stoppable

    if out is not None:
        out.mkdir(parents=True, exist_ok=True)  # before the arm moves, so that no record is lost
    bus = connect(interface, channel, bus_loop(blocks.settings).bit_rate)
    try:
        log_to(bus, log)
        with stoppable() as stop:
            live, found = drive_arm(blocks, bus, stop, seconds=seconds, realtime=realtime, torque=torque)
    finally:
        bus.shutdown()
    print(json.dumps(found) if as_json else report(found))
    if out is not None:
        live.record().save(out / f"{blocks.scenario.name}_bus.h5")
    raise typer.Exit(0 if found["ended"] == "done" else 2)


@bus_app.command()
def replay(
    file: Annotated[Path, typer.Argument(metavar="LOG", help="Log in any format that python-can reads.")],
    interface: _Interface,
    channel: _Channel,
    arm: Annotated[
        bool, typer.Option("--arm", help="Also send what drives obey: NMT, SYNC, set-points, SDO requests.")
    ] = False,
) -> None:
    """Send the frames of a log again, as far apart as they were.

    Example: lwa4d-sim bus replay run.log -i udp_multicast -c 239.74.163.2
    """
    from lwa4d_sim.bus.connect import connect
    from lwa4d_sim.bus.frame_files import replay as send_again
    from lwa4d_sim.bus.process import stoppable

    bus = connect(interface, channel)
    try:
        with stoppable() as stop:
            sent, left_out = send_again(file, bus, stop, commands=arm)
    finally:
        bus.shutdown()
    print(f"{sent} frames sent, {left_out} left out" + (" (commands; --arm sends them too)" if left_out else ""))


@bus_app.command()
def check(
    interface: _Interface,
    channel: _Channel,
    file: Annotated[
        str | None, typer.Argument(metavar="[FILE]", help="Scenario that the bus is compared with.")
    ] = None,
    variant: _Variant = None,
    overrides: Set = None,
    bit_rate: Annotated[
        int | None, typer.Option(metavar="BIT/S", min=1, help="Of the bus; default the scenario's, else 500000.")
    ] = None,
    seconds: Annotated[float, typer.Option(metavar="S", min=0.0, max=3600.0, help="Listen so long first.")] = 1.0,
    sheet: Annotated[
        Path | None, typer.Option("--eds", metavar="SHEET", help="Name the objects of this sheet that a node lacks.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Say who is on a bus and what differs from a scenario. Reads only: nothing is written, nothing enabled.

    Example: lwa4d-sim bus check -i socketcan -c can0 canopen7
    """
    from lwa4d_sim.bus.build import bus_loop, plan_for
    from lwa4d_sim.bus.connect import connect
    from lwa4d_sim.bus.differences import beside_sheet, differences
    from lwa4d_sim.bus.serve import monotonic
    from lwa4d_sim.bus.sheet import load
    from lwa4d_sim.bus.survey import Surveyor
    from lwa4d_sim.bus_tables import print_survey
    from lwa4d_sim.settings import CanopenLoop

    loop, plan = CanopenLoop(), None
    if file is not None:
        blocks = _blocks(file, variant, overrides)
        loop = bus_loop(blocks.settings)
        with blocks.about("loop"):
            plan = plan_for(blocks, loop)
    rate = bit_rate or loop.bit_rate
    objects = None if sheet is None else load(sheet)
    bus = connect(interface, channel, rate)
    try:
        with busy("looking at the bus", quiet=as_json):
            surveyor = Surveyor(bus, monotonic)
            found = surveyor.survey(rate, seconds)
            said = [] if objects is None else beside_sheet(surveyor, found, objects)
    finally:
        bus.shutdown()
    said += [] if plan is None else differences(found, plan, rate)
    if as_json:
        print(json.dumps({**asdict(found), "differences": list(map(asdict, said))}))
    else:
        print_survey(found, said)
    raise typer.Exit(1 if any(not each.rewritten for each in said) else 0)


@bus_app.command()
def eds(
    file: _File,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Folder the sheets go into.")],
    variant: _Variant = None,
    overrides: Set = None,
) -> None:
    """Write the object dictionary of each drive as an electronic data sheet.

    Example: lwa4d-sim bus eds canopen7 -o sheets
    """
    from lwa4d_sim.bus.build import write_sheets

    for path in write_sheets(_blocks(file, variant, overrides), out):
        print(path)


def _dry_run(blocks: Any) -> None:
    """Print what the master would send, taken from a run against the simulated arm."""
    from lwa4d_sim.bus.build import canopen_run
    from lwa4d_sim.bus_timing import name_of

    with blocks.about("loop"):
        simulation, ticks = canopen_run(blocks)
    for _, _tick in zip(range(3), ticks, strict=False):
        pass
    print("dry run: frames to the drives, from the simulated arm; --arm opens the bus and enables them")
    for frame in simulation.wire.frames:
        if frame.node == "master":
            data = frame.data.hex().upper()
            print(f"{frame.started / 1e9:12.6f}  {frame.can_id:03X}#{data:16}  {name_of(frame.can_id)}")


def _blocks(file: str, variant: str | None, overrides: list[str] | None) -> Any:
    """The scenario's blocks, with the loop on a bus."""
    from lwa4d_sim.assembly import build_blocks
    from lwa4d_sim.scenario import Scenario
    from lwa4d_sim.settings import CanopenLoop, IdealLoop

    scenario = Scenario.load(scenario_path(file), dict(override(text) for text in overrides or []))
    names = list(scenario.variants)
    if variant is not None and variant not in names:
        raise ScenarioError(f"{scenario.source}: no variant '{variant}'; it has {', '.join(names)}")
    fitting: list[Callable[[Any], bool]] = [
        lambda loop: isinstance(loop, CanopenLoop),
        lambda loop: not isinstance(loop, IdealLoop),
    ]
    chosen = variant or next((name for fits in fitting for name in names if fits(scenario.variants[name].loop)), None)
    if chosen is None or isinstance(scenario.variants[chosen].loop, IdealLoop):
        raise ScenarioError(f"{scenario.source}: an ideal loop has no bus; choose another variant")
    return build_blocks([scenario], chosen, 1)
