"""Channels: what arrives, when, and what never arrives, against brute force and theory."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.channels import Gate, StaggeredChannel, Transport, build_channel
from lwa4d_sim.delays import (
    ExponentialLatency,
    Latency,
    LatencyDraws,
    LatencyStream,
    Loss,
    LossDraws,
    LossStream,
    NormalLatency,
    TraceLatency,
    UniformLatency,
)
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array, Arrived, Channel, Ns

MS = 1_000_000  # [ns]
N, JOINTS = 3, 4


def payload(k: int) -> tuple[Array, ...]:
    """Data of sample k, different for every simulation and joint."""
    q = 1000.0 * k + np.arange(N * JOINTS, dtype=float).reshape(N, JOINTS)
    return q, -q


def build(transport: Transport, gate: Gate, n_sims: int = N, signal: int = 1, first_seed: int = 0) -> Channel:
    seeds = range(first_seed, first_seed + n_sims)
    return build_channel([transport] * n_sims, seeds, signal, JOINTS, gate)


def draw(latency: Latency, jitter: float, sims: int) -> LatencyDraws:
    return LatencyDraws([LatencyStream(latency, jitter, 1, np.random.SeedSequence(seed)) for seed in range(sims)])


def stamps(arrived: Arrived | None) -> Array:
    return np.full((N, JOINTS), -1) if arrived is None else np.broadcast_to(arrived.stamp, (N, JOINTS))


def same(a: Arrived | None, b: Arrived | None) -> None:
    np.testing.assert_array_equal(stamps(a), stamps(b))
    known = stamps(a) >= 0
    if known.any():
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(
            np.broadcast_to(a.since, known.shape)[known], np.broadcast_to(b.since, known.shape)[known]
        )
        for x, y in zip(a.values, b.values, strict=True):
            np.testing.assert_array_equal(x[known], y[known])


def staggered(latency: int, gate: Gate) -> Channel:
    return StaggeredChannel([Ns(latency)] * N, gate)


def direct(latency: int, gate: Gate) -> Channel:
    return build(Transport(latency=latency / 1e9), gate)


def drawn(latency: int, gate: Gate) -> Channel:
    return build(Transport(latency=UniformLatency(low=latency / 1e9, high=latency / 1e9)), gate)


def listed(latency: int, gate: Gate) -> Channel:
    return build(Transport(latency=(latency / 1e9,) * JOINTS), gate)


def replayed(latency: int, gate: Gate) -> Channel:
    return build(Transport(latency=TraceLatency(values=(latency / 1e9,))), gate)


EVERY_KIND = pytest.mark.parametrize("make", [direct, staggered, drawn, listed, replayed])


@EVERY_KIND
def test_battery_over_every_channel(make: Callable[[int, Gate], Channel]) -> None:
    channel = make(2_300_000, Gate(MS))
    assert (stamps(channel.newest(Ns(0))) == -1).all()
    assert channel.changes(Ns(0), Ns(10**12)) == []
    channel.send(Ns(0), payload(0))
    channel.send(Ns(1_500_000), payload(1))
    assert channel.changes(Ns(0), Ns(10**12)) == [3 * MS, 4 * MS]
    assert channel.changes(Ns(3 * MS), Ns(4 * MS)) == []  # strictly between
    assert channel.changes(Ns(2 * MS), Ns(4 * MS)) == [3 * MS]
    assert (stamps(channel.newest(Ns(3 * MS - 1))) == -1).all()
    for now, sample, stamp, since in [
        (3 * MS, 0, 0, 3 * MS),
        (4 * MS - 1, 0, 0, 3 * MS),
        (90 * MS, 1, 1_500_000, 4 * MS),
    ]:
        arrived = channel.newest(Ns(now))
        same(arrived, Arrived(np.array([[stamp]]), np.array([[since]]), payload(sample)))
        assert arrived is not None
        assert arrived.values[0].shape == (N, JOINTS)
    assert channel.changes(Ns(0), Ns(10**12)) == []  # all taken


@given(
    latency=st.integers(0, 12 * MS),
    grid=st.sampled_from([1, 500_000, MS]),
    sync=st.sampled_from([0, 4 * MS]),
    gaps=st.lists(st.integers(1, 5 * MS), min_size=1, max_size=12),
    step=st.integers(400_000, 3 * MS),
)
@settings(max_examples=40, derandomize=True, deadline=None)
def test_a_constant_law_is_the_plain_queue(latency: int, grid: int, sync: int, gaps: list[int], step: int) -> None:
    gate = Gate(grid, sync)
    channels = [make(latency, gate) for make in (direct, staggered, drawn, listed, replayed)]
    sends = np.cumsum(gaps)
    k = 0
    for now in range(0, int(sends[-1]) + latency + 8 * MS, step):
        while k < len(sends) and sends[k] <= now:
            for channel in channels:
                channel.send(Ns(int(sends[k])), payload(k))
            k += 1
        first, *others = channels
        for other in others:
            assert other.changes(Ns(now), Ns(now + 3 * MS)) == first.changes(Ns(now), Ns(now + 3 * MS))
            same(other.newest(Ns(now)), first.newest(Ns(now)))
    assert (stamps(channels[0].newest(Ns(10**12))) == sends[k - 1]).all()


@pytest.mark.parametrize("per_joint", [False, True])
@pytest.mark.parametrize("law", [UniformLatency(high=0.03), ExponentialLatency(minimum=0.001, tail=0.01)])
def test_random_arrivals_against_brute_force(law: UniformLatency | ExponentialLatency, per_joint: bool) -> None:
    transport = Transport(latency=law, jitter=0.002, loss=Loss(probability=0.3, mean_burst=2.0), per_joint=per_joint)
    seeds = [np.random.SeedSequence(seed, spawn_key=(1, 0)) for seed in range(N)]
    loss_seeds = [np.random.SeedSequence(seed, spawn_key=(1, 1)) for seed in range(N)]
    width = JOINTS if transport.per_joint else 1
    latency, loss = (
        LatencyDraws([LatencyStream(transport.latency, transport.jitter, width, seed) for seed in seeds]),
        LossDraws([LossStream(transport.loss, width, seed) for seed in loss_seeds]),
    )
    shape = (N, JOINTS)
    period, count = 10 * MS, 300
    arrival = np.array([k * period + np.broadcast_to(latency.next(), shape) for k in range(count)])
    lost = np.array([np.broadcast_to(loss.next(), shape) for _ in range(count)])
    arrival = np.where(lost, 10**15, -(-arrival // MS) * MS)
    assert (np.diff(np.where(lost, np.nan, arrival.astype(float)), axis=0) < 0).any()  # some do overtake
    channel = build(transport, Gate(MS))
    overtaken = 0
    for k in range(count):
        now = k * period
        channel.send(Ns(now), payload(k))
        expected = arrival[: k + 1]
        ahead = np.unique(expected[(expected > now) & (expected < now + period)])
        assert channel.changes(Ns(now), Ns(now + period)) == ahead.tolist()
        for later in (0, 4 * MS):
            here = expected <= now + later
            newest = np.where(here.any(axis=0), k - np.argmax(here[::-1], axis=0), -1)
            known = newest >= 0
            arrived = channel.newest(Ns(now + later))
            assert arrived is not None
            np.testing.assert_array_equal(stamps(arrived), np.where(known, newest * period, -1))
            since = np.take_along_axis(expected, np.maximum(newest, 0)[None], axis=0)[0]
            np.testing.assert_array_equal(arrived.since[known], since[known])
            np.testing.assert_array_equal(
                arrived.values[0][known], (1000.0 * newest + np.arange(N * JOINTS).reshape(shape))[known]
            )
            np.testing.assert_array_equal(arrived.values[1][known], -arrived.values[0][known])
            assert np.isnan(arrived.values[0][~known]).all()
            overtaken += int((here & (np.arange(k + 1)[:, None, None] < newest)).sum())
    assert overtaken > 0


def test_a_late_item_never_replaces_a_newer_one() -> None:
    channel = build(Transport(latency=TraceLatency(values=(0.05, 0.001, 0.001))), Gate(1))
    for k in range(3):
        channel.send(Ns(k * 10 * MS), payload(k))
        channel.newest(Ns(k * 10 * MS))
    before = channel.newest(Ns(22 * MS))
    assert (stamps(before) == 20 * MS).all()
    assert channel.changes(Ns(22 * MS), Ns(100 * MS)) == [50 * MS]
    same(channel.newest(Ns(60 * MS)), before)


def test_sync_latches_what_came_before_it() -> None:
    gate = Gate(MS, 10 * MS)
    arrivals = np.array([0, 1, 9 * MS, 10 * MS - 1, 10 * MS, 10 * MS + 1])
    np.testing.assert_array_equal(gate.opens(arrivals), np.array([10, 10, 10, 10, 20, 20]) * MS)
    np.testing.assert_array_equal(Gate(MS).opens(arrivals), np.array([0, 1, 9, 10, 10, 11]) * MS)


LOSSES = [Loss(probability=0.2), Loss(probability=0.7), Loss(probability=0.3, mean_burst=6.0)]


@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_loss_has_the_asked_share_and_burst_length(loss: Loss) -> None:
    sims, count = 40, 8000
    draws = LossDraws([LossStream(loss, 1, np.random.SeedSequence(seed)) for seed in range(sims)])
    lost = np.array([draws.next()[:, 0] for _ in range(count)]).T  # (sims, count)
    p, leave = loss.probability, loss.leave
    mean_burst = loss.mean_burst or 1.0 / (1.0 - p)
    # variance of the share of a two-state chain: p (1 - p) / n times (1 + r) / (1 - r), r its correlation
    r = 1.0 - leave - loss.enter
    sigma = np.sqrt(p * (1 - p) / lost.size * (1 + r) / (1 - r))
    assert abs(lost.mean() - p) < 4 * sigma + 2 / count  # and the start in the good state
    edges = np.diff(np.pad(lost, ((0, 0), (1, 1))).astype(int), axis=1)
    lengths = np.concatenate([np.flatnonzero(row == -1) - np.flatnonzero(row == 1) for row in edges])
    assert abs(lengths.mean() - mean_burst) < 4 * lengths.std() / np.sqrt(len(lengths))
    for length in (1, 2, 3):  # bursts end with the same probability at every sample
        expected = leave * (1 - leave) ** (length - 1)
        assert abs((lengths == length).mean() - expected) < 4 * np.sqrt(expected / len(lengths))


@pytest.mark.parametrize("per_joint", [False, True])
def test_per_joint_draws_joint_by_joint(per_joint: bool) -> None:
    transport = Transport(latency=UniformLatency(high=0.01), loss=Loss(probability=0.5), per_joint=per_joint)
    channel = build(transport, Gate(1))
    differ = 0
    for k in range(100):
        channel.send(Ns(k * 10 * MS), payload(k))
        found = stamps(channel.newest(Ns(k * 10 * MS + 5 * MS)))
        differ += int((found != found[:, :1]).any())
    assert differ > 50 if per_joint else differ == 0


@pytest.mark.parametrize(
    "law",
    [
        UniformLatency(low=0.002, high=0.009),
        NormalLatency(mean=0.005, std=0.001),
        ExponentialLatency(minimum=0.003, tail=0.002),
    ],
)
def test_laws_have_their_moments(law: UniformLatency | NormalLatency | ExponentialLatency) -> None:
    draws = draw(law, 0.0, 20)
    seconds = np.array([draws.next() for _ in range(2000)]) / 1e9
    mean, std = {
        "uniform": (0.0055, 0.007 / np.sqrt(12)), "normal": (0.005, 0.001), "exponential": (0.005, 0.002)
    }[law.kind]  # fmt: skip
    assert abs(seconds.mean() - mean) < 4 * std / np.sqrt(seconds.size)
    assert seconds.std() == pytest.approx(std, rel=0.03)
    assert seconds.min() >= 0
    assert (seconds <= Transport(latency=law).usual_longest + 1e-9).mean() >= 0.95


def test_jitter_is_added_and_a_trace_is_replayed() -> None:
    trace = TraceLatency(values=(0.001, 0.004, 0.002))
    plain = draw(trace, 0.0, 2)
    assert [plain.next().ravel().tolist() for _ in range(4)] == [[MS, MS], [4 * MS] * 2, [2 * MS] * 2, [MS, MS]]
    plain, shaken = draw(trace, 0.0, 2), draw(trace, 0.003, 2)
    extra = np.array([shaken.next() - plain.next() for _ in range(900)]) / 1e9
    assert 0 <= extra.min() < 1e-4
    assert 0.0029 < extra.max() <= 0.003
    assert Transport(latency=trace, jitter=0.003).usual_longest == pytest.approx(0.007)


def test_streams_depend_on_seed_and_signal_alone() -> None:
    transport = Transport(latency=UniformLatency(high=0.02), loss=Loss(probability=0.2), per_joint=True)

    def history(n_sims: int, signal: int, first_seed: int) -> Array:
        channel = build(transport, Gate(1), n_sims, signal, first_seed)
        found = []
        for k in range(700):  # more than one block of draws
            channel.send(Ns(k * 10 * MS), (np.full((n_sims, JOINTS), float(k)),))
            arrived = channel.newest(Ns(k * 10 * MS))
            assert arrived is not None
            found.append(arrived.stamp)
        return np.array(found)

    together = history(5, 1, 0)
    np.testing.assert_array_equal(together[:, 3:4], history(1, 1, 3))
    assert (together[:, 0] != together[:, 1]).any()
    assert (history(1, 2, 3) != together[:, 3:4]).any()


def test_wrong_parameters_are_named() -> None:
    with pytest.raises(ValueError, match=r"high \(=0\.001\) must not be below low \(=0\.002\)"):
        UniformLatency(low=0.002, high=0.001)
    with pytest.raises(ValueError, match=r"mean_burst \(=1\.0\) is too short for probability \(=0\.8\)"):
        Loss(probability=0.8, mean_burst=1.0)
    with pytest.raises(ScenarioError, match="has 2 values; give one number or one for each of 4 joints"):
        build(Transport(latency=(0.0, 0.001)), Gate(1))
