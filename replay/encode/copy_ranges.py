"""Copy many ranges of bytes between buffers, complete columns of messages at a time."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

# Max number of different lengths for copies length by length; with more, copies are single.
FEW_LENGTHS: Final = 32
# Mean size in bytes from which single copies are as fast.
LARGE: Final = 4096


def copy_ranges(
    target: NDArray[np.uint8],
    target_start: NDArray[np.int64],
    source: NDArray[np.uint8],
    source_start: NDArray[np.int64],
    length: NDArray[np.int64],
) -> None:
    """Copy N ranges of bytes; ranges of one length are copied together if there are few lengths."""
    if not len(length):
        return
    mean = int(length.sum()) // len(length)
    are_equal = bool((length == length[0]).all())
    lengths = length[:1] if are_equal or mean >= LARGE else np.unique(length)
    if mean >= LARGE or len(lengths) > FEW_LENGTHS:
        to, of = target.data, source.data
        rows = zip(target_start.tolist(), source_start.tolist(), length.tolist(), strict=True)
        for put, take, size in rows:
            to[put : put + size] = of[take : take + size]
        return
    for size in lengths.tolist():
        if size == 0:
            continue
        rows_ = slice(None) if len(lengths) == 1 else length == size
        to_view, of_view = _windows(target, size), _windows(source, size)
        to_view[target_start[rows_]] = of_view[source_start[rows_]]


def _windows(buffer: NDArray[np.uint8], width: int) -> NDArray[np.void]:
    """Return a view of a buffer with an item of ``width`` bytes at every position."""
    view: NDArray[np.void] = np.ndarray(
        (len(buffer) - width + 1,), f"V{width}", buffer.data, strides=(1,)
    )
    return view
