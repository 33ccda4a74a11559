"""Random numbers of a drive, independent of the process and the time of its simulation.

The generator is SplitMix64 with a separate step for each stream (Steele, Lea, Flood, *Fast
splittable pseudorandom number generators*, OOPSLA 2014). The k-th number is a hash of key and k, so
it is a counter-based generator. Normal variates use the ziggurat method (Marsaglia, Tsang 2000; the
layout of Doornik 2005) with 256 layers.

A stream is a NamedTuple of its state and step. Each function returns a number and the stream after
it. All integers are uint64 with wrapping arithmetic; outside compiled code, call the functions
under ``numpy.errstate(over="ignore")``.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats

GOLDEN: Final = np.uint64(0x9E3779B97F4A7C15)
MIX_1: Final = np.uint64(0xBF58476D1CE4E5B9)
MIX_2: Final = np.uint64(0x94D049BB133111EB)
FLIP: Final = np.uint64(0xAAAAAAAAAAAAAAAA)
MIN_TRANSITIONS: Final = 24
TO_UNIT: Final = 2.0**-53
LAYERS: Final = 256
LAYER_MASK: Final = np.uint64(LAYERS - 1)
TAIL_FROM: Final = 3.6541528853610088
ZERO, ONE, U11, U27, U30, U31 = (np.uint64(n) for n in (0, 1, 11, 27, 30, 31))


class RandomStream(NamedTuple):
    """State of the random numbers of one key."""

    state: np.uint64
    step: np.uint64


def mix(number: np.uint64) -> np.uint64:
    """Apply SplitMix64's finaliser, a bijection of 64-bit numbers that mixes all bits."""
    number = (number ^ (number >> U30)) * MIX_1
    number = (number ^ (number >> U27)) * MIX_2
    return number ^ (number >> U31)


def combine_keys(key: np.uint64, part: np.uint64) -> np.uint64:
    """Combine a key and a number to a new key; the order matters."""
    return mix(key ^ mix(part + GOLDEN)) + GOLDEN


def key_of(*parts: int) -> int:
    """Combine several numbers to one 64-bit key; the order matters."""
    key = ZERO
    with np.errstate(over="ignore"):
        for part in parts:
            key = combine_keys(key, np.uint64(part))
    return int(key)


def stream_of(seed: np.uint64, purpose: np.uint64) -> RandomStream:
    """Create a drive's stream for one purpose."""
    key = combine_keys(combine_keys(ZERO, seed), purpose)
    step = mix(key ^ GOLDEN) | ONE
    transitions, left = 0, step ^ (step >> ONE)
    while left != ZERO:
        left &= left - ONE
        transitions += 1
    return RandomStream(key, step ^ FLIP if transitions < MIN_TRANSITIONS else step)


def uniform(stream: RandomStream) -> tuple[float, RandomStream]:
    """Draw a uniform number in [0, 1), a multiple of 2**-53."""
    state = stream.state + stream.step
    return np.int64(mix(state) >> U11) * TO_UNIT, RandomStream(state, stream.step)


def below(stream: RandomStream, n: int) -> tuple[int, RandomStream]:
    """Draw an integer in [0, n)."""
    number, stream = uniform(stream)
    return int(number * n), stream


def normal(stream: RandomStream) -> tuple[float, RandomStream]:
    """Draw a standard normal number."""
    while True:
        stream = RandomStream(stream.state + stream.step, stream.step)
        bits = mix(stream.state)
        layer = np.int64(bits & LAYER_MASK)
        place = 2.0 * np.int64(bits >> U11) * TO_UNIT - 1.0
        if abs(place) < INNER[layer]:
            return place * EDGE[layer], stream
        if layer == 0:
            tail, stream = _tail(stream)
            return (-tail if place < 0.0 else tail), stream
        x = place * EDGE[layer]
        low = math.exp(-0.5 * (EDGE[layer] ** 2 - x * x))
        high = math.exp(-0.5 * (EDGE[layer + 1] ** 2 - x * x))
        height, stream = uniform(stream)
        if high + height * (low - high) < 1.0:
            return x, stream


def _tail(stream: RandomStream) -> tuple[float, RandomStream]:
    """Draw a positive number from the tail beyond the last layer."""
    while True:
        one, stream = uniform(stream)
        other, stream = uniform(stream)
        x, y = math.log(1.0 - one) / TAIL_FROM, math.log(1.0 - other)
        if -2.0 * y >= x * x:
            return TAIL_FROM - x, stream


def _layers() -> tuple[Floats, Floats]:
    """Right edges of the layers, shape (257,), and the fraction of each inside the next, (256,).

    All layers have the same area; the first one includes the tail.
    """
    r = TAIL_FROM
    tail = math.sqrt(math.pi / 2.0) * math.erfc(r / math.sqrt(2.0))
    area = r * math.exp(-0.5 * r * r) + tail
    edge = np.zeros(LAYERS + 1)
    edge[0], edge[1] = area * math.exp(0.5 * r * r), r
    for i in range(2, LAYERS):
        height = area / edge[i - 1] + math.exp(-0.5 * edge[i - 1] ** 2)
        edge[i] = math.sqrt(-2.0 * math.log(height))
    return edge, edge[1:] / edge[:-1]


EDGE, INNER = _layers()
