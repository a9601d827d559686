"""The joint model of all digits: what it is trained on, how it is told a digit, and that the stored one draws it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from inflate_lib import describe, inflate, label_image, paths, simulate_dataset
from inflate_lib.alternatives.digits_model import (
    DigitSet,
    held_out_digits,
    load_digits_model,
    told_digit,
    train_digits,
)
from inflate_lib.datasets.pairs import held_out
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.descriptors.registry import JOINT
from inflate_lib.models.recipe import load_recipe
from inflate_lib.structures import load_digits

TINY = {"channels": [4, 8], "embedding": 16, "steps": 8, "batch_size": 16, "checkpoint_every": 8}


@pytest.fixture(scope="module")
def data():
    found = load_digits([3, 7], "digits", 50)
    return simulate_dataset(found.images, n_jobs=1, n_steps=1).assign(digit=("structure", found.labels))


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    recipe = load_recipe("laptop")
    recipe = replace(recipe, training={**recipe.training, **TINY})
    return train_digits(data, recipe, tmp_path_factory.mktemp("checkpoints"))


def test_every_tenth_of_each_digit_is_held_out_as_it_is_of_the_sevens_alone():
    digit = np.random.default_rng(0).integers(10, size=500)
    kept = held_out_digits(digit)
    for one in range(10):
        assert np.array_equal(kept[digit == one], held_out((digit == one).sum()))


def test_pairs_hold_the_digit_and_nothing_of_what_is_held_out(data):
    pairs = DigitSet(data, JOINT, 80)
    images, conditions = pairs.pairs
    seen = np.flatnonzero(data.converged.values & ~held_out_digits(data.digit.values))
    assert len(images) == len(conditions) == 80 and conditions.shape[1] == 107
    assert np.array_equal(images[: len(seen)], data["image"].values[seen])
    assert np.array_equal(conditions[: len(seen), :97], descriptor_matrix(data, JOINT)[seen])
    source = seen[pairs.variants[:, 0]]  # also of those that are mirrored or shifted
    assert np.array_equal(conditions[:, 97:].argmax(axis=1), data.digit.values[source])
    assert (conditions[:, 97:].sum(axis=1) == 1).all() and len(pairs.unseen[0]) == 50 - len(seen) > 3


def test_a_model_that_is_always_told_a_digit_answers_as_the_one_that_can_be_told_it(trained):
    draw = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for weight in trained.net.parameters():  # a few steps leave the last layers near zero
            weight += 0.1 * torch.randn(weight.shape, generator=draw)
    x, t = torch.randn(6, 1, 28, 28, generator=draw), torch.arange(0, 600, 100)
    told = torch.rand(6, 97, generator=draw)
    told[0, 0] = told[1, 5:65] = torch.nan  # no height; no axis
    answers = []
    for digit in (None, 3, 7):
        whole = torch.full((6, 10), torch.nan) if digit is None else torch.eye(10)[[digit] * 6]
        with torch.no_grad():
            alone = told_digit(trained, digit).net(x, t, told)
            assert torch.allclose(trained.net(x, t, torch.cat([told, whole], dim=1)), alone, atol=1e-5)
        answers.append(alone)
    assert not torch.allclose(answers[0], answers[1], atol=1e-2)
    assert not torch.allclose(answers[1], answers[2], atol=1e-2)
    with pytest.raises(ValueError, match="digit must be a whole number from 0 to 9, not 10"):
        told_digit(trained, 10)


def test_a_profile_without_such_a_model_is_told():
    with pytest.raises(FileNotFoundError, match="ci"):
        load_digits_model(profile="ci")


def test_the_stored_model_draws_what_it_is_asked_for_and_the_digit_it_is_told():
    model = load_digits_model()
    assert model.trained.metadata["held_out"] == "every tenth of each digit"
    wanted = [0.75, 1.2]
    heights = [
        np.median([describe(result).height for image in model.draw({"height": h}, 6) if (result := inflated(image))])
        for h in wanted
    ]
    assert heights == pytest.approx(wanted, rel=0.1)
    ones, zeros = (load_digits_model(digit).draw({"height": 0.9}, 6) for digit in (1, 0))
    middle = np.s_[:, 12:16, 12:16]
    assert np.median(ones[middle].mean(axis=(1, 2))) > 0.5 > 2 * np.median(zeros[middle].mean(axis=(1, 2)))


def inflated(image):
    """Its inflation, or None where it is no structure."""
    try:
        result = inflate(label_image(image))
    except ValueError:
        return None
    return result if result.converged else None


def test_the_stored_files_are_small():
    folder = paths.PRETRAINED / "laptop" / "digits"
    assert sum(file.stat().st_size for file in folder.iterdir()) < 3e6
