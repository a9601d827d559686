"""The autoencoder: its bound is right, and it is as large as the model beside it."""

import numpy as np
import pytest
import torch
from torch.distributions import Bernoulli, Normal, kl_divergence

from inflate_lib.alternatives.autoencoder import (
    Autoencoder,
    _kl_to_standard_normal,
    _nearest_width,
    _reconstruction_nll,
    _TrainedAutoencoder,
)
from inflate_lib.diffusion.randomness import initialised


def test_kl_is_that_of_torch():
    mean, log_variance = torch.randn(7, 5), torch.randn(7, 5)
    theirs = kl_divergence(Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0)).sum(dim=1)
    torch.testing.assert_close(_kl_to_standard_normal(mean, log_variance), theirs)
    assert _kl_to_standard_normal(torch.zeros(1, 5), torch.zeros(1, 5)).item() == 0


def test_reconstruction_is_the_likelihood_of_bright_and_dark_pixels():
    images, decoded = torch.rand(6, 28, 28), torch.rand(6, 28, 28)
    dark = -Bernoulli(decoded).log_prob(torch.zeros_like(images)).flatten(1).sum(dim=1)
    torch.testing.assert_close(_reconstruction_nll(torch.zeros_like(images), decoded), dark)
    bright = (images > 0.5).float()
    expected = -Bernoulli(decoded).log_prob(bright).flatten(1).sum(dim=1)
    torch.testing.assert_close(_reconstruction_nll(bright, decoded), expected)
    # A grey pixel is bright in its share of the cases, so that no other probability serves it better than its grey.
    for other in (decoded, 0.9 * images, 0.1 + 0.9 * images):
        assert (_reconstruction_nll(images, other) > _reconstruction_nll(images, images)).all()


@pytest.mark.parametrize(("n_conditions", "n_parameters"), [(1, 369_721), (60, 574_361)])
def test_the_autoencoder_is_as_large_as_the_model_beside_it(n_conditions, n_parameters):
    net = Autoencoder(n_conditions, _nearest_width(n_conditions, n_parameters))
    assert net.n_parameters == pytest.approx(n_parameters, rel=0.05)


def test_what_the_autoencoder_draws_depends_on_seed_number_and_target_alone():
    net = initialised(lambda: Autoencoder(1, 4), seed=0)
    model = _TrainedAutoencoder(net, np.array([0.0]), np.array([2.0]), 0, 0.0)
    images = model.generate(np.array([[0.5], [1.0], [1.5]]), seed=1)
    assert images.shape == (3, 28, 28) and 0 <= images.min() and images.max() <= 1
    np.testing.assert_allclose(model.generate(np.array([[0.5], [1.0]]), seed=1), images[:2], atol=1e-6)
    assert not np.allclose(model.generate(np.array([[0.5]]), seed=2), images[:1], atol=1e-6)
