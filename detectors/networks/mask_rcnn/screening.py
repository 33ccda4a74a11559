"""Screen proposals with an approximate box head, and run the exact one on the remaining ones.

About fifty of a thousand proposals contain an object, but the box head costs the same for each.
Most of that is its first layer, which the product of two thin matrices approximates (truncated SVD;
Girshick 2015, section 3.1). Approximate scores only reject proposals; every detection has exact
scores.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from .parts import TorchParts

# Number of proposals above which screening saves time.
MIN_PROPOSALS: Final = 200
# Rank of the approximation, as a fraction of the layer's outputs.
RANK: Final = 3 / 16
# Maximum error of an approximate score, in log-odds, that does not lose a detection.
MARGIN: Final = 2.5
# Interval of proposals that always get exact scores, to measure the approximation's error.
CHECKED: Final = 40


def can_screen(network: Any) -> bool:
    """Whether a network's box head is torchvision's of two layers, with scores from a third."""
    from torchvision.models.detection.faster_rcnn import TwoMLPHead

    heads = network.roi_heads
    scores = getattr(heads.box_predictor, "cls_score", None)
    return isinstance(heads.box_head, TwoMLPHead) and isinstance(scores, nn.Linear)


class ScreenedParts(TorchParts):
    """All parts in torch on a CPU, with approximate logits for proposals of low score."""

    def __init__(self, network: Any) -> None:
        """Approximate the first layer of a network that ``can_screen``.

        The network's minimum score must be set before.
        """
        super().__init__(network, torch.device("cpu"))
        self._heads: Final = network.roi_heads
        self._min_logit: Final = float(torch.logit(torch.tensor(float(self._heads.score_thresh))))
        first = self._heads.box_head.fc6
        with torch.inference_mode():
            # The left singular vectors, from a matrix whose size is independent of the inputs.
            _, left = torch.linalg.eigh(first.weight @ first.weight.T)
            rank = max(round(RANK * first.out_features), 1)
            self._wide: Final = left[:, -rank:].contiguous()
            # Pooled boxes have their channels last, so that these rows have too.
            thin = self._wide.T @ first.weight
            thin = thin.unflatten(1, (network.backbone.out_channels, -1))
            self._narrow: Final = thin.transpose(1, 2).flatten(1).contiguous()

    def boxes(self, pooled: Tensor, /) -> tuple[Tensor, Tensor]:
        """As ``Parts``; offsets are 0 where logits are approximate."""
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
    """Log-odds of each row's most probable class other than the background."""
    return torch.logit(functional.softmax(logits, 1)[:, 1:].amax(1))
