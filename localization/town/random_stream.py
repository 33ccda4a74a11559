"""Random numbers that belong to a drive, whatever process drives it and when.

SplitMix64 with a step of its own for each stream (Steele, Lea, Flood, *Fast splittable pseudorandom
number generators*, OOPSLA 2014): the k-th number is a hash of key and k, so it is a counter-based
generator. Normals by the ziggurat method (Marsaglia, Tsang 2000; the layout of Doornik 2005) with
256 layers.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats

MASK: Final = (1 << 64) - 1
GOLDEN: Final = 0x9E3779B97F4A7C15
MIX_1: Final = 0xBF58476D1CE4E5B9
MIX_2: Final = 0x94D049BB133111EB
FEW_TRANSITIONS: Final = 24
FLIP: Final = 0xAAAAAAAAAAAAAAAA
TO_UNIT: Final = 2.0**-53
LAYERS: Final = 256
TAIL_FROM: Final = 3.6541528853610088


def mix(number: int) -> int:
    """The finaliser of SplitMix64: a bijection of 64-bit numbers in which every bit matters."""
    number &= MASK
    number = ((number ^ (number >> 30)) * MIX_1) & MASK
    number = ((number ^ (number >> 27)) * MIX_2) & MASK
    return number ^ (number >> 31)


def key_of(*parts: int) -> int:
    """One 64-bit key from several numbers; their order matters."""
    key = 0
    for part in parts:
        key = mix(key ^ mix(part + GOLDEN)) + GOLDEN & MASK
    return key


def step_of(key: int) -> int:
    """A stream's odd step, without those that have too few changes of bit."""
    step = mix(key ^ GOLDEN) | 1
    return step ^ FLIP if (step ^ (step >> 1)).bit_count() < FEW_TRANSITIONS else step


class Ziggurat(NamedTuple):
    """Layers under the bell curve.

    Attributes:
        edge: Shape (257,): right edges, widest first; the first holds the tail's area.
        inner: Shape (256,): share of each layer that lies inside the next.
    """

    edge: Floats
    inner: Floats


@cache
def ziggurat() -> Ziggurat:
    """The layers, each of the same area."""
    r = TAIL_FROM
    tail = math.sqrt(math.pi / 2.0) * math.erfc(r / math.sqrt(2.0))
    area = r * math.exp(-0.5 * r * r) + tail
    edge = np.zeros(LAYERS + 1)
    edge[0], edge[1] = area * math.exp(0.5 * r * r), r
    for i in range(2, LAYERS):
        height = area / edge[i - 1] + math.exp(-0.5 * edge[i - 1] ** 2)
        edge[i] = math.sqrt(-2.0 * math.log(height))
    return Ziggurat(edge, edge[1:] / edge[:-1])


class Stream:
    """Numbers of one key, in order."""

    def __init__(self, key: int) -> None:
        """Begin before the first number of ``key``."""
        self._state = key & MASK
        self._step = step_of(key)

    def bits(self) -> int:
        """64 random bits."""
        self._state = (self._state + self._step) & MASK
        return mix(self._state)

    def uniform(self) -> float:
        """In [0, 1), a multiple of 2**-53."""
        return (self.bits() >> 11) * TO_UNIT

    def below(self, n: int) -> int:
        """A whole number in [0, n)."""
        return int(self.uniform() * n)

    def normal(self) -> float:
        """Standard normal."""
        edge, inner = ziggurat()
        while True:
            bits = self.bits()
            layer = bits & (LAYERS - 1)
            share = 2.0 * (bits >> 11) * TO_UNIT - 1.0
            if abs(share) < inner[layer]:
                return float(share * edge[layer])
            if layer == 0:
                return self._tail(share < 0.0)
            x = share * edge[layer]
            low = math.exp(-0.5 * (edge[layer] ** 2 - x * x))
            high = math.exp(-0.5 * (edge[layer + 1] ** 2 - x * x))
            if high + self.uniform() * (low - high) < 1.0:
                return float(x)

    def _tail(self, is_negative: bool) -> float:
        while True:
            x = math.log(1.0 - self.uniform()) / TAIL_FROM
            y = math.log(1.0 - self.uniform())
            if -2.0 * y >= x * x:
                return x - TAIL_FROM if is_negative else TAIL_FROM - x
