"""Tests of the decoding of each layout from constant tensors, for a non-square input.

Every decoder of the table has a sample with known boxes. It refuses outputs of another shape with a
message. ``tests/contracts/test_network_families.py`` recognises and decodes files of each family.
"""

import numpy as np
import pytest

from crosscue.detectors.decoders.base import BoxOutput, decoder_name
from crosscue.detectors.decoders.table import DECODERS
from support.decoder_samples import BOX, CLASSES, SAMPLES, SIZE, Sample


@pytest.fixture(params=DECODERS, ids=decoder_name)
def decoder(request: pytest.FixtureRequest) -> type[BoxOutput]:
    found: type[BoxOutput] = request.param
    return found


def _built(decoder: type[BoxOutput]) -> tuple[BoxOutput, Sample]:
    sample = SAMPLES[decoder_name(decoder)]()
    return decoder.model_validate({"classes": CLASSES, **sample.settings}), sample


def test_masks_cover_the_network_input(decoder: type[BoxOutput]) -> None:
    output, sample = _built(decoder)
    found = output.candidates(sample.outputs, SIZE)

    assert (found.masks is not None) == sample.is_masked
    if found.masks is not None:
        (mask,) = found.masks(np.array([int(found.scores.argmax())]))
        columns = (mask > 0.5).mean(axis=0)
        middle = BOX[[0, 2]].mean() / SIZE[0] * len(columns)
        np.testing.assert_array_equal(columns, np.arange(len(columns)) < int(middle))


def test_output_of_another_shape_is_refused(decoder: type[BoxOutput]) -> None:
    output, sample = _built(decoder)
    for name in sample.outputs:
        changed = {**sample.outputs, name: np.zeros((1, 5, 11, 2, 2))}

        with pytest.raises(ValueError, match=r"expected|boxes|masks|prototypes"):
            output.candidates(changed, SIZE)
