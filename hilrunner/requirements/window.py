"""Least and greatest values over sliding windows of a sampled signal, all samples at once.

A window reaches from `begin` to `end` samples ahead of each sample, both included, and is cut where the signal ends; an empty window has the
value that decides nothing (infinity for the least, minus infinity for the greatest), as in the discrete-time semantics of RTAMT.
"""

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d


def least(values: np.ndarray, begin: int, end: int | None) -> np.ndarray:
    """min of values[t + begin .. t + end] for every t; `end` None: to the end of the signal. float64[n] -> float64[n]."""
    return _slide(values, begin, end, minimum_filter1d, np.minimum, np.inf)


def greatest(values: np.ndarray, begin: int, end: int | None) -> np.ndarray:
    """max of values[t + begin .. t + end] for every t; see `least`."""
    return _slide(values, begin, end, maximum_filter1d, np.maximum, -np.inf)


def _slide(values, begin, end, filtered, accumulated, nothing):
    count = len(values)
    shifted = np.full(count, nothing)
    if begin < count:
        shifted[: count - begin] = values[begin:]
    if end is None or end - begin >= count:
        return accumulated.accumulate(shifted[::-1])[::-1]
    size = end - begin + 1
    if size == 1:
        return shifted
    # the filter's window is centred: move it so that it begins at each sample
    return filtered(
        shifted, size, mode="constant", cval=nothing, origin=-(size // 2) if size % 2 else -(size // 2 - 1) - 1
    )


def until(held: np.ndarray, reached: np.ndarray, begin: int, end: int | None) -> np.ndarray:
    """max over t' in [t + begin, t + end] of min(reached[t'], min held[t .. t' - 1]), for every t; float64[n]."""
    count = len(held)
    if end is None or end >= count:
        return _until_unbounded(held, reached, begin)
    best = np.full(count, -np.inf)
    so_far = np.full(count, np.inf)  # least of held[t .. t + k - 1]
    for k in range(end + 1):
        if k >= begin:
            ahead = np.full(count, -np.inf)
            ahead[: count - k] = reached[k:]
            np.maximum(best, np.minimum(ahead, so_far), out=best)
        shifted = np.full(count, -np.inf)
        shifted[: count - k] = held[k:]
        np.minimum(so_far, shifted, out=so_far)
    return best


def _until_unbounded(held: np.ndarray, reached: np.ndarray, begin: int) -> np.ndarray:
    count = len(held)
    result = np.empty(count)
    later = -np.inf
    for t in range(count - 1, -1, -1):
        later = max(reached[t], min(held[t], later))
        result[t] = later
    if begin == 0:
        return result
    moved = np.full(count, -np.inf)
    if begin < count:
        moved[: count - begin] = result[begin:]
    return np.minimum(moved, least(held, 0, begin - 1))
