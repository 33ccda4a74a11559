"""Image times are computed from the device's millisecond counter and the log's clock."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import Int64s
from crosscue.replay.mobileye.clock import (
    GAP_NS,
    LONG_GAP,
    OUT_OF_ORDER,
    SET_ANEW,
    WENT_BACK,
    CounterClock,
    unwrap,
)

MS = 1_000_000


def camera(n: int, period_ms: int = 66, drift: float = 0.0) -> tuple[Int64s, Int64s]:
    """Return image times on the log's clock, and the device's counter at these times."""
    image_ns = 10**18 + np.arange(n, dtype=np.int64) * period_ms * MS
    device_ns = (np.arange(n) * period_ms * MS * (1 + drift)).astype(np.int64) + 77 * MS
    return image_ns, device_ns // MS & 0xFF


def error_without_offset(image_ns: Int64s, truth_ns: Int64s) -> Int64s:
    """Return the error minus its median, because a constant offset cannot be observed."""
    error = image_ns - truth_ns
    return error - np.int64(np.median(error))


def test_evenly_spaced_arrivals_are_the_image_times() -> None:
    image_ns, counter_ms = camera(50)
    found = unwrap(counter_ms, image_ns)

    np.testing.assert_allclose(found.image_ns, image_ns, atol=MS)
    assert found.notices == ()


@given(seed=st.integers(0, 1000), period_ms=st.integers(50, 110), jitter_ms=st.integers(0, 90))
@settings(max_examples=40, deadline=None)
def test_arrival_jitter_is_removed(seed: int, period_ms: int, jitter_ms: int) -> None:
    rng = np.random.default_rng(seed)
    image_ns, counter_ms = camera(400, period_ms)
    latency_ns = 5 * MS + rng.exponential(jitter_ms * MS / 5 + 1, 400).clip(0, jitter_ms * MS)
    log_ns = np.maximum.accumulate(image_ns + latency_ns.astype(np.int64))
    found = unwrap(counter_ms, log_ns).image_ns

    settled = np.s_[60:]
    assert np.abs(error_without_offset(found[settled], image_ns[settled])).max() <= 4 * MS
    assert (np.diff(found) >= 0).all()
    assert (found <= log_ns).all()


@given(
    counters=st.lists(st.integers(0, 255), min_size=1, max_size=60),
    steps=st.lists(st.integers(0, 3 * 10**11), min_size=60, max_size=60),
)
@settings(max_examples=60, deadline=None)
def test_image_times_are_ordered_and_precede_their_frames(
    counters: list[int], steps: list[int]
) -> None:
    log_ns = np.cumsum(np.array(steps[: len(counters)], dtype=np.int64))
    found = unwrap(np.array(counters), log_ns).image_ns

    assert (np.diff(found) >= 0).all()
    assert (found <= log_ns).all()
    assert (log_ns - found).max() < 256 * MS or (np.diff(found) == 0).any()


@given(seed=st.integers(0, 1000), cut=st.integers(0, 300))
@settings(max_examples=20, deadline=None)
def test_image_times_do_not_depend_on_block_division(seed: int, cut: int) -> None:
    rng = np.random.default_rng(seed)
    image_ns, counter_ms = camera(300)
    log_ns = image_ns + rng.integers(0, 40 * MS, 300)
    clock = CounterClock()
    pieces = [
        clock.feed(counter_ms[:cut], log_ns[:cut]),
        clock.feed(counter_ms[cut:], log_ns[cut:]),
    ]

    np.testing.assert_array_equal(np.concatenate(pieces), unwrap(counter_ms, log_ns).image_ns)


def test_dropped_frames_and_gaps_longer_than_a_wrap_are_bridged() -> None:
    image_ns, counter_ms = camera(600)
    kept = np.flatnonzero((np.arange(600) < 100) | (np.arange(600) > 400))
    kept = kept[np.random.default_rng(1).random(len(kept)) > 0.3]
    found = unwrap(counter_ms[kept], image_ns[kept])

    np.testing.assert_allclose(found.image_ns, image_ns[kept], atol=MS)
    assert found.notices == ()


@pytest.mark.parametrize("drift", [-100e-6, 100e-6])
def test_one_hour_of_drift_misses_no_wrap(drift: float) -> None:
    """100 parts per million are 360 ms per hour, more than the counter can hold."""
    image_ns, counter_ms = camera(54_000, drift=drift)
    log_ns = image_ns + np.random.default_rng(2).integers(0, 8 * MS, 54_000)
    found = unwrap(counter_ms, log_ns)

    assert np.abs(error_without_offset(found.image_ns[60:], image_ns[60:])).max() < 4 * MS
    assert found.notices == ()


def test_slow_first_frame_does_not_offset_later_images() -> None:
    image_ns, counter_ms = camera(200)
    log_ns = image_ns + 5 * MS
    log_ns[0] += 55 * MS
    found = unwrap(counter_ms, log_ns)

    np.testing.assert_allclose(error_without_offset(found.image_ns[10:], image_ns[10:]), 0, atol=MS)


def test_host_stall_does_not_change_image_times() -> None:
    image_ns, counter_ms = camera(200)
    log_ns = image_ns + 5 * MS
    stalled = (log_ns > log_ns[100]) & (log_ns < log_ns[100] + 200 * MS)
    log_ns[stalled] = log_ns[100] + 200 * MS
    found = unwrap(counter_ms, log_ns)

    np.testing.assert_allclose(found.image_ns, log_ns[0] + image_ns - image_ns[0], atol=MS)


def test_device_restart_is_followed_and_reported() -> None:
    image_ns, counter_ms = camera(400)
    counter_ms = np.where(np.arange(400) < 200, counter_ms, (counter_ms - 100) & 0xFF)
    found = unwrap(counter_ms, image_ns)

    np.testing.assert_allclose(found.image_ns[280:], image_ns[280:], atol=2 * MS)
    assert any(n.startswith(f"{SET_ANEW} (1 times") for n in found.notices)


def test_log_clock_set_back_restarts_image_times() -> None:
    image_ns, counter_ms = camera(100)
    log_ns = np.where(np.arange(100) < 50, image_ns, image_ns - 10**12)
    found = unwrap(counter_ms, log_ns)

    np.testing.assert_allclose(found.image_ns, log_ns, atol=MS)
    assert found.notices == (f"{WENT_BACK} (1 times, first at {log_ns[50]} ns)",)


def test_gap_too_long_for_drift_is_reported() -> None:
    log_ns = np.array([0, GAP_NS + 1], dtype=np.int64)
    assert unwrap(np.array([0, 9]), log_ns).notices[0].startswith(LONG_GAP)


def test_stall_longer_than_a_wrap_is_reported() -> None:
    image_ns, counter_ms = camera(100)
    log_ns = image_ns + 5 * MS
    stalled = (np.arange(100) >= 50) & (log_ns < log_ns[50] + 330 * MS)
    log_ns[stalled] = log_ns[50] + 330 * MS
    found = unwrap(counter_ms, log_ns)

    assert any(n.startswith(OUT_OF_ORDER) for n in found.notices)
    np.testing.assert_allclose(error_without_offset(found.image_ns[60:], image_ns[60:]), 0, atol=MS)


def test_minimum_latency_shifts_all_image_times() -> None:
    image_ns, counter_ms = camera(20)
    log_ns = image_ns + 80 * MS
    unwrapped = unwrap(counter_ms, log_ns, min_latency_ns=80 * MS)

    np.testing.assert_allclose(unwrapped.image_ns, image_ns, atol=MS)
