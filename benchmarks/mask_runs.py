"""Masks as COCO run lengths: ours next to pycocotools, on an ellipse in a picture of 1280 x 720."""

from __future__ import annotations

import timeit
from collections.abc import Callable

import numpy as np
from pycocotools import mask as coco

from crosscue.detectors import rle

SIZE = (1280, 720)
CORNER = (500, 300)
ROUNDS, REPEATS = 5, 50
DAMAGED = b"P\x7f\x7f"


def main() -> None:
    y, x = np.mgrid[:60, :120]
    box = ((y - 30) ** 2 / 900 + (x - 60) ** 2 / 3600) < 1.0

    def theirs() -> bytes:
        whole = np.zeros(SIZE[::-1], np.uint8, order="F")
        whole[300:360, 500:620] = box
        return bytes(coco.encode(whole)["counts"])

    text = rle.encode_mask(box, CORNER, SIZE)
    tree = {"size": list(SIZE[::-1]), "counts": text}
    if theirs() != text or not np.array_equal(coco.decode(tree), rle.decode_mask(text, SIZE)):
        raise SystemExit("the two differ")
    jobs: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        "encode": (lambda: rle.encode_mask(box, CORNER, SIZE), theirs),
        "decode": (lambda: rle.decode_mask(text, SIZE), lambda: coco.decode(tree)),
        "area": (lambda: rle.area_px(text), lambda: coco.area(tree)),
    }
    for name, pair in jobs.items():
        ours, peers = (
            min(timeit.repeat(job, number=REPEATS, repeat=ROUNDS)) / REPEATS * 1e6 for job in pair
        )
        print(f"{name:7} ours {ours:7.0f} us  pycocotools {peers:7.0f} us  x{peers / ours:.1f}")
    pixels = int(coco.decode({"size": [72, 128], "counts": DAMAGED}).sum())
    print(f"damaged {DAMAGED!r}: pycocotools finds {pixels} pixels in a picture of {72 * 128}")


if __name__ == "__main__":
    main()
