"""Latin hypercube samples of any size, any part of which can be made alone.

A Latin hypercube of n points puts exactly one point in each of n slices of every coordinate. The usual construction
shuffles n numbers a coordinate and must hold them all; here the shuffle is a keyed permutation (a Feistel network with
cycle walking), so point i is computed from i, the seed and n. Chunks can be made in any order, by any number of
processes, and resumed; splits are ranges of i, so no slice and no point is ever shared between them.
"""

from dataclasses import dataclass

import numpy as np

from hilrunner.base import compiled

from numba import uint64  # isort: skip

_ROUNDS = 4


@dataclass(frozen=True)
class Split:
    """A range of point numbers of one Latin hypercube."""

    name: str
    first: int
    count: int


def splits(train: int, validation: int, test: int) -> tuple[Split, Split, Split]:
    """Training, validation and test points: consecutive ranges of one hypercube, disjoint by construction."""
    return (
        Split("train", 0, train),
        Split("validation", train, validation),
        Split("test", train + validation, test),
    )


@compiled.hot
def _mixed(value, key):
    """A 64-bit hash of a value under a key (finaliser of SplitMix64, Steele et al. 2014)."""
    z = uint64(value) + uint64(key) * uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> uint64(27))) * uint64(0x94D049BB133111EB)
    return z ^ (z >> uint64(31))


@compiled.hot
def _permuted(index, count, half_bits, key):
    """Where a keyed permutation of 0..count-1 sends `index`."""
    mask = (uint64(1) << uint64(half_bits)) - uint64(1)
    value = uint64(index)
    while True:  # cycle walking: the Feistel network permutes a power of four that is less than 4 count
        left = value >> uint64(half_bits)
        right = value & mask
        for turn in range(_ROUNDS):
            left, right = right, left ^ (_mixed(right, key * uint64(_ROUNDS) + uint64(turn)) & mask)
        value = (left << uint64(half_bits)) | right
        if value < uint64(count):
            return value


@compiled.entry
def _fill(out, first, count, half_bits, seed):
    for i in range(out.shape[0]):
        for d in range(out.shape[1]):
            key = _mixed(uint64(d + 1), uint64(seed))
            slice_index = _permuted(uint64(first + i), count, half_bits, key)
            inside = _mixed(uint64(first + i), key ^ uint64(0xA5A5A5A5A5A5A5A5)) >> uint64(11)
            out[i, d] = (float(slice_index) + float(inside) * 2.0**-53) / count


def unit_points(first: int, rows: int, count: int, dimensions: int, seed: int) -> np.ndarray:
    """Points first .. first + rows of a Latin hypercube of `count` points in the unit cube, float64[rows, dimensions]."""
    if not 0 <= first <= first + rows <= count:
        raise ValueError(f"points {first}..{first + rows} of a hypercube of {count}")
    half_bits = max(1, (max(count - 1, 1).bit_length() + 1) // 2)
    out = np.empty((rows, dimensions))
    _fill(out, first, count, half_bits, seed)
    return out
