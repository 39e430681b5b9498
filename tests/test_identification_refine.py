"""Delay, friction's shape and masses, found again from motion; and what a recording cannot tell."""

import logging
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lwa4d_sim.edits import ArmEdits
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.adjustable import REACH, What
from lwa4d_sim.identification.inertia import standard_parameters
from lwa4d_sim.identification.refine import Refined, refine
from lwa4d_sim.identification.shooting import Pieces, cut
from lwa4d_sim.identification.slack import Inertia, Slack
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import load_model, model_path
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.recordings.run_data import from_run
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

sysid = pytest.importorskip("mujoco.sysid")
if not hasattr(sysid, "optimize"):
    pytest.skip("the extra lwa4d_sim[sysid] is not installed", allow_module_level=True)

PERIOD = 0.01
COUNT = 1.7453e-5  # [rad]; a millidegree, as the drives of the LWA4D count
# Joints with rotors and friction like the wrist's, where a PD over the bus is stable. None is in the shipped models.
JOINTS = {"joint2": (1.0, (8.0, 0.0, 0.0), 2.0), "joint4": (0.5, (5.0, 0.0, 0.0), 1.0)}
SEGMENT = 0.25  # [s]; shorter than usual, as the runs are
SHAPE: tuple[What, ...] = ("delay", "friction")
SCENARIO = """
name: excited
arm: {arm}
initial: {{q: [0, -1.5708]}}
trajectory:
  kind: fourier
  a: [[0.156, -0.478, 0.078, -0.388, -0.070], [0.064, -0.335, 0.451, 0.292, 1.046]]
  b: [[0.088, 0.253, -0.207, 0.549, 0.150], [-0.125, 0.292, -0.369, 0.557, 0.964]]
  duration: 2.6
controller: {{kind: pd_gravity, space: joint, kp: [200, 80], kd: [20, 8]}}
plant: {{mass_scale: {mass_scale}}}
loop: {{kind: sampled, period: 0.01, position_resolution: 1.7453e-5, latency: {{measurement: 0.002, command: {delay}}}}}
"""


def arm(folder: Path, **changes: tuple[float, tuple[float, ...], float]) -> Path:
    """The planar arm with armature, damping polynomial and friction loss at its joints."""
    text = model_path("lwa4d_planar").read_text(encoding="utf-8")
    text = re.sub(r'<asset>.*</asset>|material="\w+"', "", text, flags=re.DOTALL)  # textures take time to compile
    for joint, (armature, damping, coulomb) in {**JOINTS, **changes}.items():
        tag = f'<joint name="{joint}"'
        assert tag in text
        poly = " ".join(map(str, damping))
        text = text.replace(tag, f'{tag} armature="{armature}" damping="{poly}" frictionloss="{coulomb}"')
    path = folder / f"arm{len(list(folder.iterdir()))}.xml"
    path.write_text(text, encoding="utf-8")
    return path


def recorded(plant: Path, delay: Any = 0.0, mass_scale: Sequence[float] = (1.0, 1.0)) -> Recording:
    """A run over a link that delays commands, and a recording that knows nothing of that."""
    document = SCENARIO.format(arm=plant, delay=delay, mass_scale=list(mass_scale))
    recording = from_run(run(Scenario.parse(document)), "bus")
    return replace(recording, since=recording.since - np.asarray(delay))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("arms")


@pytest.fixture(scope="module")
def nominal(folder: Path) -> Path:
    return arm(folder)


@pytest.fixture(scope="module")
def plain(nominal: Path) -> Recording:
    return recorded(nominal)


def errors(found: Refined, truth: dict[str, float]) -> Array:
    """How many standard errors each estimate is off; what is not named is as before."""
    true = [truth.get(name, start) for name, start in zip(found.names, found.start, strict=True)]
    return np.asarray(np.abs(found.estimate - true) / found.std_error)


# -- what is there is found --------------------------------------------------------------------------------------------


def test_delay_and_quadratic_friction_are_found_together(folder: Path, nominal: Path) -> None:
    plant = arm(folder, joint2=(1.0, (8.0, 3.0, 0.0), 2.0), joint4=(0.5, (5.0, 2.0, 0.0), 1.0))
    steps: list[None] = []
    found = refine(nominal, recorded(plant, 0.003), what=SHAPE, segment=SEGMENT, advance=lambda: steps.append(None))
    value = dict(zip(found.names, found.estimate, strict=True))
    truth = {"delay": 0.003, "joint2.quadratic": 3.0, "joint4.quadratic": 2.0}
    assert errors(found, truth).max() < 3.0
    assert abs(value["delay"] - 0.003) < 2e-4
    assert value["joint2.quadratic"] == pytest.approx(3.0, rel=0.01)
    assert value["joint4.quadratic"] == pytest.approx(2.0, rel=0.01)
    assert (found.before > 20 * found.after).all()
    assert found.after == pytest.approx(COUNT / np.sqrt(12), rel=0.1), "what is left is the encoder's rounding"
    assert steps
    assert not found.remarks


def test_where_there_is_nothing_to_find_zero_is_found(nominal: Path, plain: Recording) -> None:
    found = refine(nominal, plain, what=SHAPE, segment=SEGMENT)
    assert errors(found, {}).max() < 3.0
    assert (found.after < found.before).all()
    assert found.before == pytest.approx(COUNT / np.sqrt(12), rel=0.3), "the encoder's rounding, and guessed starts"
    assert dict(zip(found.names, found.std_error, strict=True))["delay"] < 1e-5


def test_each_joint_has_its_delay_offset_and_mass(nominal: Path) -> None:
    """The masses come from the scenario's own way of changing an arm."""
    recording = recorded(nominal, [0.001, 0.004], mass_scale=(0.95, 1.1))
    biased = replace(recording, tau=recording.tau + np.array([0.8, -0.5]))
    found = refine(nominal, biased, what=("mass", "offset", "delays"), segment=SEGMENT)
    truth = {"joint2.delay": 0.001, "joint4.delay": 0.004, "link2.scale": 0.95, "link4.scale": 1.1}
    assert found.names == (*list(truth)[:2], "joint2.offset", "joint4.offset", *list(truth)[2:])
    assert errors(found, {**truth, "joint2.offset": 0.8, "joint4.offset": -0.5}).max() < 3.0
    assert found.units == ("s", "s", "N m", "N m", "1", "1")
    values = dict(zip(found.names, found.estimate, strict=True))
    assert abs(values["joint4.delay"] - 0.004) < 2e-4
    assert values["link4.scale"] == pytest.approx(1.1, rel=1e-3)


def test_a_delay_is_found_behind_wrong_inertia(nominal: Path) -> None:
    """Two roads to one model: its masses known, and its inertia fitted along."""
    recording = recorded(nominal, 0.003, mass_scale=(0.97, 1.02))
    fixed = refine(nominal, recording, what=("delay",), segment=SEGMENT)
    along = refine(nominal, recording, what=("delay", "inertia"), segment=SEGMENT)
    assert errors(along, {"delay": 0.003}).max() < 3.0
    assert abs(along.estimate[0] - 0.003) < 2e-5
    assert abs(fixed.estimate[0] - 0.003) > 6e-5, "what is taken as exact has to be"
    # of 450 samples 43 go into starts and inertia, which leaves 0.95 of the encoder's rounding; and chance
    assert along.after == pytest.approx(0.95 * COUNT / np.sqrt(12), rel=0.1)


def test_lost_samples_and_unknown_torques_cost_pieces_and_nothing_else(nominal: Path) -> None:
    recording = recorded(nominal, 0.003)
    q, tau = recording.q.copy(), recording.tau.copy()
    q[np.random.default_rng(1).random(q.shape) < 0.05] = np.nan
    q[60:90] = np.nan
    tau[200] = np.nan
    whole = refine(nominal, recording, what=("delay",), segment=SEGMENT)
    found = refine(nominal, replace(recording, q=q, tau=tau), what=("delay",), segment=SEGMENT)
    assert found.pieces <= whole.pieces - 2
    assert errors(found, {"delay": 0.003}).max() < 3.0


def test_an_arm_at_rest_tells_nothing(nominal: Path) -> None:
    t = np.arange(300.0)[:, None].repeat(2, axis=1) * PERIOD
    q = np.tile([-np.pi / 2, 0.0], (300, 1))  # hanging
    none = np.zeros(2)
    still = Recording(
        joints=("joint2", "joint4"),
        t=t,
        q=q,
        since=t,
        tau=np.zeros_like(q),
        position_step=none,
        torque_step=none,
        end=3.0,
        source="a test",
    )
    found = refine(nominal, still, what=("delay", "friction"))
    assert np.isnan(found.estimate).all()
    assert np.isinf(found.std_error).all()
    assert found.remarks[0].startswith("the motion does not tell delay, joint2.viscous")


# -- pieces ------------------------------------------------------------------------------------------------------------


def toy(tau: Array, period: float = PERIOD) -> Recording:
    """One joint whose torque changes every period, and whose position is a cubic."""
    t = np.arange(len(tau))[:, None] * period
    one = np.zeros(1)
    return Recording(
        joints=("j",),
        t=t + 0.3 * period,
        q=0.2 + t - 2 * t**2 + 0.5 * t**3,
        since=t,
        tau=tau[:, None],
        position_step=one,
        torque_step=one,
        end=len(tau) * period,
        source="toy",
    )


@given(st.floats(-REACH, REACH), st.integers(0, 2**31))
def test_a_delayed_torque_counts_by_its_share(delay: float, seed: int) -> None:
    """Against the mean of a fine sampling; and no impulse is lost."""
    recording = toy(np.random.default_rng(seed).normal(size=120))
    pieces = cut(recording, 0.2, 0.004, REACH, 4)
    tau = pieces.torque(np.array([delay]))[..., 0]
    fine = 2000
    t = pieces.start[:, None] + 0.004 / fine * (np.arange(pieces.steps * fine) + 0.5) - delay
    exact = recording.tau[(t / PERIOD).astype(int), 0].reshape(len(t), -1, fine).mean(axis=-1)
    np.testing.assert_allclose(tau, exact, atol=3 * np.abs(recording.tau).max() / fine)


def test_positions_between_steps_are_a_cubic() -> None:
    recording = toy(np.zeros(120))
    pieces = cut(recording, 0.2, 0.004, REACH, 4)
    t = pieces.start[:, None] + 0.004 * np.arange(pieces.steps + 1)
    q, dq = np.polyval([0.5, -2, 1, 0.2], t - 0.003), np.polyval([1.5, -4, 1], t - 0.003)
    sampled = pieces.sampled(np.stack([q, dq], axis=-1))
    assert pieces.there.sum() >= 20 * len(pieces.start)
    np.testing.assert_allclose(sampled[pieces.there], pieces.q[pieces.there], atol=1e-12)
    np.testing.assert_allclose(pieces.state, np.stack([q, dq], axis=-1)[:, 0], atol=1e-9)


@given(st.integers(0, 2**31), st.booleans())
def test_what_nobody_asks_for_is_left_out(seed: int, dark: bool) -> None:
    rng = np.random.default_rng(seed)
    change, shared = rng.normal(size=(3, 20, 2, 4)), rng.normal(size=(3, 20, 2, 2))
    change[..., 2] *= not dark  # a start without effect
    slack = Slack.of(change, shared, np.array([1.0, 1e-3]))
    starts, parameters, noise = rng.normal(size=(3, 4)), rng.normal(size=2), rng.normal(size=(3, 20, 2))
    starts[:, 2] *= not dark
    explained = np.einsum("smnk,sk->smn", change, starts) + shared @ parameters
    assert slack.rank == (11 if dark else 14)
    assert np.abs(slack.left(explained)).max() < 1e-9
    np.testing.assert_allclose(slack.left(explained + noise), slack.left(noise), atol=1e-9)
    np.testing.assert_allclose(slack.left(slack.left(noise)), slack.left(noise), atol=1e-9)
    for found, true in zip(slack.explained(explained), (starts, parameters), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-9)


def test_other_inertia_is_as_other_torque(nominal: Path) -> None:
    """Against MuJoCo's inverse dynamics of an arm with other masses and rotors."""
    model, other = load_model(str(nominal)), load_model(str(nominal), ArmEdits(mass_scale=(0.9, 1.2), armature=0.7))
    q, dq, ddq = np.random.default_rng(2).normal(size=(3, 4, 2))
    step = 1e-6
    ends = [np.concatenate([q + s * step / 2 * dq, dq + s * step / 2 * ddq], axis=-1) for s in (-1, 1)]
    inertia = Inertia.along(model, np.stack(ends, axis=1), step)
    change = np.concatenate([standard_parameters(other) - standard_parameters(model)], axis=None)
    change = np.append(change, other.dof_armature - model.dof_armature)
    torque = [[_inverse(m, *state) for state in zip(q, dq, ddq, strict=True)] for m in (model, other)]
    np.testing.assert_allclose((inertia.Y @ change)[:, 0], np.subtract(torque[1], torque[0]), atol=1e-7)
    np.testing.assert_allclose(inertia.Y @ inertia.back, inertia.base, atol=1e-9)
    flat = inertia.base.reshape(8, -1)
    np.testing.assert_allclose(flat.T @ flat, 4 * np.eye(flat.shape[1]), atol=1e-9)


def _inverse(model: Any, q: Array, dq: Array, ddq: Array) -> Array:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
    mujoco.mj_inverse(model, data)
    return np.array(data.qfrc_inverse)


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_without_the_extra_it_says_so(nominal: Path, plain: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(sysid, "optimize")  # as the package is where its own requirements are missing
    with pytest.raises(IdentificationError, match=r"pip install 'lwa4d_sim\[sysid\]'$"):
        refine(nominal, plain)
    monkeypatch.setitem(sys.modules, "mujoco.sysid", None)
    monkeypatch.delattr("mujoco.sysid")
    with pytest.raises(IdentificationError, match=r"pip install 'lwa4d_sim\[sysid\]'$"):
        refine(nominal, plain)


def bad() -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """What is said, changes of the recording, and of the call."""
    yield "has 2 joints, the arm has 7", {}, {"model_path": model_path("lwa4d_7dof")}
    yield "0 pieces of 0.5 s have positions and torques throughout; at least 4", {"end": 0.3}, {}
    yield "2 pieces of 1 s", {}, {"segment": 1.0}
    yield "pieces of 0.05 s are too short for samples every 0.01 s; give at least 0.1 s", {}, {"segment": 0.05}
    yield "0 samples are too few for a spline", {"q": np.nan}, {}
    yield "0 pieces", {"tau": np.nan}, {}
    yield "give delay or delays", {}, {"what": ("delay", "delays")}
    yield "give delay or delays", {}, {"what": ()}
    yield "mass or inertia, not both", {}, {"what": ("mass", "inertia")}


@pytest.mark.parametrize(("said", "recording", "call"), [pytest.param(*row, id=row[0][:20]) for row in bad()])
def test_bad_input_is_one_line(
    nominal: Path, plain: Recording, said: str, recording: dict[str, Any], call: dict[str, Any]
) -> None:
    changes: dict[str, Any] = {k: np.full_like(plain.q, v) if k in ("q", "tau") else v for k, v in recording.items()}
    with pytest.raises(IdentificationError, match=said) as error:
        refine(**{"model_path": nominal, "recording": replace(plain, **changes), **call})
    assert "\n" not in str(error.value)


def test_nothing_is_printed_and_logging_stays_as_it_was(
    folder: Path, plain: Recording, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The library warns of parameters that start at a bound, the engine of states that are no numbers."""
    monkeypatch.setattr(logging.root, "handlers", [])  # as in a program that has set up none
    away = arm(folder, joint2=(0.0, (0.0, -100.0, 0.0), 0.0))
    with pytest.raises(IdentificationError, match="the model runs away from this motion"):
        refine(away, plain, segment=SEGMENT)
    bare = arm(folder, joint4=(0.5, (5.0, 0.0, 0.0), 0.0))
    t, q, since, tau = (signal[:80] for signal in (plain.t, plain.q, plain.since, plain.tau))
    short = replace(plain, t=t, q=q, since=since, tau=tau, end=0.8)
    refine(bare, short, what=SHAPE, segment=0.1)
    assert capfd.readouterr() == ("", "")
    assert logging.root.handlers == []
    assert not logging.getLogger("absl").disabled


def test_of_a_long_recording_pieces_are_spread_over_it() -> None:
    pieces: Pieces = cut(toy(np.zeros(3000)), 0.2, 0.01, REACH, 10)
    assert len(pieces.start) == 10
    assert pieces.start[0] < 0.1
    assert pieces.start[-1] > 29.5
    assert np.ptp(np.diff(pieces.start)) < 0.21
