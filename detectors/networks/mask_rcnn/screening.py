"""A rough look at every proposal, and a close one at those that it does not rule out.

Of a thousand proposals about fifty hold an object, yet the box head costs as much for each. Its
first layer is most of that, and a product of two thin matrices stands in for it roughly (truncated
singular values; Girshick 2015, section 3.1). Rough scores only rule out: what is
found was examined closely.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from .parts import TorchParts

FEWEST: Final = 200
"""Proposals from which it pays."""
RANK: Final = 3 / 16
"""Of the thin matrices, as a fraction of the layer's outputs."""
MARGIN: Final = 2.5
"""Log-odds by which a rough score may be too low before a detection could be lost."""
CHECKED: Final = 40
"""Every so many proposals one is examined closely in any case, to see how wrong the rough is."""


def can_screen(network: Any) -> bool:
    """Whether its box head is torchvision's of two layers, with scores from a third."""
    from torchvision.models.detection.faster_rcnn import TwoMLPHead

    heads = network.roi_heads
    scores = getattr(heads.box_predictor, "cls_score", None)
    return isinstance(heads.box_head, TwoMLPHead) and isinstance(scores, nn.Linear)


class ScreenedParts(TorchParts):
    """All parts in torch on a processor; what cannot reach the least score gets rough logits."""

    def __init__(self, network: Any) -> None:
        """Of a network that ``can_screen``; its least score is taken as it is now."""
        super().__init__(network, torch.device("cpu"))
        self._heads: Final = network.roi_heads
        self._min_logit: Final = float(torch.logit(torch.tensor(float(self._heads.score_thresh))))
        first = self._heads.box_head.fc6
        with torch.inference_mode():
            # The left singular vectors, from a matrix that is small however wide the layer is.
            _, left = torch.linalg.eigh(first.weight @ first.weight.T)
            rank = max(round(RANK * first.out_features), 1)
            self._wide: Final = left[:, -rank:].contiguous()
            # Pooled boxes have their channels last, so that these rows have too.
            thin = self._wide.T @ first.weight
            thin = thin.unflatten(1, (network.backbone.out_channels, -1))
            self._narrow: Final = thin.transpose(1, 2).flatten(1).contiguous()

    def boxes(self, pooled: Tensor, /) -> tuple[Tensor, Tensor]:
        """As ``Parts``; shifts are 0 where logits are rough."""
        logits = self._rough(pooled)
        rough = _log_odds(logits)
        is_close = rough >= self._min_logit - MARGIN
        is_close[::CHECKED] = True
        rows = is_close.nonzero()[:, 0]
        close, close_shifts = super().boxes(pooled[rows])
        exact = _log_odds(close)
        counts = exact >= self._min_logit - MARGIN
        if bool((counts & (exact - rough[rows] > MARGIN / 2.0)).any()):
            return super().boxes(pooled)
        logits[rows] = close
        shifts = close_shifts.new_zeros((len(pooled), close_shifts.shape[1]))
        shifts[rows] = close_shifts
        return logits, shifts

    def _rough(self, pooled: Tensor) -> Tensor:
        head, first = self._heads.box_head, self._heads.box_head.fc6
        thin = functional.linear(pooled.permute(0, 2, 3, 1).flatten(1), self._narrow)
        hidden = functional.relu(functional.linear(thin, self._wide, first.bias))
        logits: Tensor = self._heads.box_predictor.cls_score(functional.relu(head.fc7(hidden)))
        return logits


def _log_odds(logits: Tensor) -> Tensor:
    """Of each row's likeliest class that is not background."""
    return torch.logit(functional.softmax(logits, 1)[:, 1:].amax(1))
