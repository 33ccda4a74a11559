"""Road pixels of simulated pictures: those on the map's road that no object hides."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from crosscue.datasets.scenes.rendering.ground import TEXELS_PER_M, X_M, Y_M
from crosscue.datasets.scenes.rendering.render import RenderedFrame
from support.scenes import renderer, when_at, world


@cache
def picture(layout: str, x_m: float) -> RenderedFrame:
    of = world(layout)
    return renderer(of).picture(when_at(of, x_m), with_road=True)


@pytest.mark.slow
@pytest.mark.parametrize(("layout", "x_m"), [("D", -30.0), ("D", -8.0), ("A", -15.0)])
def test_road_mask_agrees_with_map(layout: str, x_m: float) -> None:
    of, shown = world(layout), picture(layout, x_m)
    assert shown.road is not None
    rng = np.random.default_rng(3)
    points = np.column_stack(
        [rng.uniform(x_m + 6, x_m + 45, 4000), rng.uniform(-25, 25, 4000), np.zeros(4000)]
    )
    column, row, depth = shown.view.project(points).T
    high, wide = shown.road.shape
    inside = (depth > 0) & (column >= 0) & (column < wide - 1) & (row >= 0) & (row < high - 1)
    column, row = column[inside].astype(int), row[inside].astype(int)
    texel = ((points[inside, :2] - [X_M[0], Y_M[0]]) * TEXELS_PER_M).astype(int)
    on_road = of.ground.road[texel[:, 1], texel[:, 0]]
    # A pixel at this distance is over a metre long, so points that close to a kerb are omitted.
    kerb = int(1.5 * TEXELS_PER_M)
    clear = np.ones_like(on_road)
    for dx, dy in ((kerb, 0), (-kerb, 0), (0, kerb), (0, -kerb)):
        clear &= of.ground.road[texel[:, 1] + dy, texel[:, 0] + dx] == on_road
    clear &= depth[inside] < 20.0
    seen = shown.road[row, column]

    assert not seen[clear & ~on_road].any()
    # An object may hide the road.
    assert seen[clear & on_road].mean() > 0.9
    assert on_road.any()
    assert not on_road.all()
