"""Derivatives by the adjoint are those of an independent potential, and worth something for whole pixels."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from mechanics_peers import hook, potential
from scipy.stats import combine_pvalues, spearmanr

from inflate_lib import build_mesh, describe, inflate, label_image
from inflate_lib.descriptors import get_descriptor
from inflate_lib.descriptors.registry import basic
from inflate_lib.descriptors.shape import area_gradient
from inflate_lib.inverse.adjoint import flip_changes, sensitivities
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.refine import _most_promising, attempt, border, refine, with_flipped
from inflate_lib.inverse.targets import Targets
from inflate_lib.structures.labels import WALL
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images
WITH_GRADIENT = [one.name for one in basic() if one.gradient is not None]


def _by_pixel(result, name):
    return sensitivities(result, get_descriptor(name).gradient)


def relaxed_equilibrium(mesh, deformed, p, shares):
    """Deformed nodes where the elements have these shares of their energy: Newton's method in PyTorch, from nearby."""
    free, x, shares = torch.from_numpy(~mesh.clamped), torch.from_numpy(deformed), torch.from_numpy(shares)

    def energy(u):
        return potential(mesh, x.index_put((free,), u.reshape(-1, 2)), p, True, shares)

    u = x[free].ravel()
    for _ in range(8):
        step = torch.linalg.solve(torch.func.hessian(energy)(u), -torch.func.grad(energy)(u))
        u = u + step
        if float(step.abs().max()) < 1e-13:
            break
    return x.index_put((free,), u.reshape(-1, 2)).numpy()


@pytest.fixture(scope="module")
def disturbed():
    """A structure, and equilibria that PyTorch finds where its walls are a little stiffer or softer, for central
    differences: in random directions and for single elements."""
    result, p, h = inflate(build_mesh(hook()), pressure=0.03), 0.03, 1e-5
    m, found = len(result.cells), []
    for direction in (*np.random.default_rng(0).normal(size=(2, m)), *np.eye(m)[:: m // 3]):
        both = [relaxed_equilibrium(result.mesh, result.deformed(), p, 1 + e * direction) for e in (h, -h)]
        found.append((direction, *both))
    return result, found, h


@pytest.mark.parametrize("name", WITH_GRADIENT)
def test_derivatives_are_those_of_the_independent_potential(disturbed, name):
    result, equilibria, h = disturbed
    derivative = _by_pixel(result, name)
    for direction, stiffer, softer in equilibria:
        plus, minus = (describe(shape).vector(name)[0] for shape in (stiffer, softer))
        assert direction @ derivative == pytest.approx((plus - minus) / (2 * h), rel=1e-5, abs=1e-8)


@pytest.mark.parametrize("name", WITH_GRADIENT)
def test_stiffer_walls_are_the_same_as_less_pressure(name):
    """Only the ratio of pressure and stiffness matters: dh/ds for all elements together is −p dh/dp."""
    for image in DIGITS[:40:8]:
        label, h = label_image(image), 1e-4
        result = inflate(label)
        plus, minus = (describe(inflate(label, pressure=0.01 * (1 + e))).vector(name)[0] for e in (h, -h))
        assert _by_pixel(result, name).sum() == pytest.approx(-(plus - minus) / (2 * h), rel=1e-4)


def test_area_of_a_polygon_follows_its_corners():
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    outwards = np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [-1.0, 0.0]])  # the left side, of length 1
    assert np.sum(area_gradient(square) * outwards) == pytest.approx(1)
    assert np.sum(area_gradient(square) * [1.0, 1.0]) == pytest.approx(0)  # moved as a whole


def test_the_changes_of_a_flip_are_added_up():
    """The estimate for each flip is the sum over the pixels whose label it changes, found by making the label image."""
    label = label_image(DIGITS[3])
    sensitivity = np.random.default_rng(1).normal(size=int((label == WALL).sum()))
    estimate, on_wall, compared = flip_changes(label, sensitivity), np.zeros(label.shape), 0
    on_wall[label == WALL] = sensitivity
    for row, column in border(label):
        flipped = label_image(with_flipped(label, [(row, column)]))
        gone, new = (label == WALL) & (flipped != WALL), (label != WALL) & (flipped == WALL)
        if new.any():  # those take the derivatives of a neighbour, or the structure was moved
            continue
        assert estimate[row, column] == pytest.approx(-on_wall[gone].sum(), abs=1e-12)
        compared += 1
    assert compared >= 5


def test_estimates_put_whole_pixels_in_the_right_order():
    """Real changes of the height go with the estimated ones over the flips of several structures, beyond all chance."""
    chances = []
    for image in DIGITS[::30]:
        label = label_image(image)
        result = inflate(label)
        estimate, height = (
            flip_changes(label, _by_pixel(result, "height")),
            describe(result).height,
        )
        pairs = []
        for row, column in border(label)[::3]:
            reason, _, flipped = attempt(with_flipped(label, [(row, column)]), Constraints())
            if not reason:
                pairs.append((estimate[row, column], describe(flipped).height - height))
        chances.append(spearmanr(*np.transpose(pairs), alternative="greater").pvalue)
    assert combine_pvalues(chances).pvalue < 1e-6


def test_the_most_promising_pixel_is_the_one_whose_estimate_fits():
    label = label_image(DIGITS[0])
    result = inflate(label)
    estimate, pixels = flip_changes(label, _by_pixel(result, "height")), border(label)
    for share in (0.99, 1.01):
        wanted = share * describe(result).height
        alone = np.stack([pixels, pixels], axis=1)  # a change of one pixel names it twice
        first, _ = _most_promising(alone, label, result, Targets(height=wanted))[0]
        missed = np.abs(describe(result).height + estimate[tuple(pixels.T)] - wanted)
        assert tuple(first) == tuple(pixels[missed.argmin()])


@pytest.mark.slow
def test_an_order_by_sensitivity_needs_fewer_inflations():
    spent = {"sensitivity": 0, "random": 0}
    for number, image in enumerate(DIGITS[:48:4]):
        reason, label, result = attempt(image, Constraints())
        if reason:
            continue
        targets = Targets(height=(1.02 if number % 2 else 0.98) * describe(result).height)
        for order in spent:
            trace = []
            refine(label, result, targets, Constraints(), 0.002, 60, number, order, trace)
            assert all(after <= before for before, after in pairwise(trace))
            spent[order] += len(trace)
    assert spent["sensitivity"] < spent["random"]


def test_what_has_no_sensitivity_is_refused():
    result = inflate(hook())
    with pytest.raises(ValueError, match="order must be one of"):
        refine(hook(), result, Targets(height=1), Constraints(), 0.01, 10, order="alphabetical")
    burst = inflate(hook(), pressure=5.0)
    assert not burst.converged
    with pytest.raises(ValueError, match="no equilibrium"):
        _by_pixel(burst, "height")
