"""Tests of the decoding of each layout from constant tensors, for a non-square input.

Every decoder of the table has a sample with known boxes. It returns these boxes, refuses outputs of
another shape with a message, and ``recognise`` finds it from the shapes that a file declares.
"""

import numpy as np
import pytest

from crosscue.detectors.decoders.base import BoxOutput, Interface, Tensor, decoder_name
from crosscue.detectors.decoders.table import DECODERS
from support.decoder_samples import BOX, CLASS, CLASSES, SAMPLES, SCORE, SIZE, Sample, input_shape


@pytest.fixture(params=DECODERS, ids=decoder_name)
def decoder(request: pytest.FixtureRequest) -> type[BoxOutput]:
    found: type[BoxOutput] = request.param
    return found


def _built(decoder: type[BoxOutput]) -> tuple[BoxOutput, Sample]:
    sample = SAMPLES[decoder_name(decoder)]()
    return decoder.model_validate({"classes": CLASSES, **sample.settings}), sample


def test_best_candidate_is_the_sample_box(decoder: type[BoxOutput]) -> None:
    output, sample = _built(decoder)

    found = output.candidates(sample.outputs, SIZE)

    best = int(found.scores.argmax())
    np.testing.assert_allclose(found.boxes_px[best], BOX, atol=1e-6)
    assert found.scores[best] == pytest.approx(SCORE, abs=1e-9)
    assert found.classes[best] == CLASS
    assert (np.delete(found.scores, best) < 0.3).all()


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


def interface(sample: Sample, names: tuple[str, ...] = CLASSES) -> Interface:
    return Interface(
        tuple(Tensor(name, shape or input_shape(sample)) for name, shape in sample.inputs.items()),
        tuple(
            Tensor(name, array.shape, array.dtype.kind == "i")
            for name, array in sample.outputs.items()
        ),
        {},
        names,
    )


def test_recognised_settings_decode_the_sample(decoder: type[BoxOutput]) -> None:
    _, sample = _built(decoder)

    guess = decoder.recognise(interface(sample))

    assert guess is not None
    assert guess.class_count in (None, len(CLASSES))
    output = decoder.model_validate({**guess.settings, "classes": CLASSES})
    found = output.candidates(sample.outputs, SIZE)
    np.testing.assert_allclose(found.boxes_px[found.scores.argmax()], BOX, atol=1e-6)
