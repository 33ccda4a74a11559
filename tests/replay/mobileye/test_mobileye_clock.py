"""Image times are computed from the device's millisecond counter and the log's clock."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.columns import Int64s
from crosscue.replay.mobileye.clock import SET_ANEW, WENT_BACK, unwrap

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


@given(seed=st.integers(0, 1000), period_ms=st.integers(50, 110), jitter_ms=st.integers(0, 90))
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
def test_image_times_are_ordered_and_precede_their_frames(
    counters: list[int], steps: list[int]
) -> None:
    log_ns = np.cumsum(np.array(steps[: len(counters)], dtype=np.int64))
    found = unwrap(np.array(counters), log_ns).image_ns

    assert (np.diff(found) >= 0).all()
    assert (found <= log_ns).all()
    assert (log_ns - found).max() < 256 * MS or (np.diff(found) == 0).any()


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
