"""Samplers against exact Gaussian results and diffusers; generate()'s promises."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from diffusion_peers import SCHEDULE, Mixture, ddim_law, diffusers_scheduler
from scipy.stats import kstest

from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate, process
from inflate_lib.diffusion.sampling import (
    _SAMPLERS,
    _extrapolated,
    _timesteps,
    ancestral_step,
    ddim_step,
    denoise,
    guided,
)

MEAN, DEVIATION = 0.2, 0.1  # of the Gaussian toy
GAUSSIAN = Mixture([1.0], [MEAN], [DEVIATION])
TWO_HILLS = Mixture([0.3, 0.7], [-0.5, 0.4], [0.1, 0.2])
PREDICTION_TYPES = {"epsilon": "epsilon", "v": "v_prediction"}


def sampled(data, n, objective, sampler, steps=1000, eta=1.0, seed=1):
    """n numbers that a sampler draws with the perfect network, (n,)."""
    g = torch.Generator().manual_seed(seed)
    noise = iter(lambda: torch.randn(n, 1, 1, 1, generator=g, dtype=torch.float64), None)

    def predict(x, t):
        return data.answer(x, t, objective)

    *_, x = denoise(predict, SCHEDULE, noise, objective, sampler, steps, eta, clip=False)
    return x.flatten().numpy()


def propagated(sampler, steps, eta):
    """Mean and deviation that the sampler must end with: its update is linear, so both follow exactly."""
    times = _timesteps(1000, steps)
    m, v = 0.0, 1.0
    for t, before in zip(times, [*times[1:], -1], strict=True):
        now, alpha, beta = (x[t].item() for x in (SCHEDULE.alpha_bars, SCHEDULE.alphas, SCHEDULE.betas))
        left = SCHEDULE.alpha_bars[before].item() if before >= 0 else 1.0
        slope = (1 - now) ** 0.5 / (now * DEVIATION**2 + 1 - now)  # ε_θ(x) = slope · (x − √ᾱ mean)
        if sampler == "ancestral":  # Eq. 10
            on_x, on_noise, added = (
                alpha**-0.5,
                -(beta * alpha**-0.5) / (1 - now) ** 0.5,
                beta if t > 0 else 0.0,
            )
        else:  # Song et al., Eq. 12
            added = eta**2 * (1 - left) / (1 - now) * (1 - now / left)
            on_x = (left / now) ** 0.5
            on_noise = max(0.0, 1 - left - added) ** 0.5 - (left / now * (1 - now)) ** 0.5
        m = on_x * m + on_noise * slope * (m - now**0.5 * MEAN)
        v = (on_x + on_noise * slope) ** 2 * v + added
    return m, v**0.5


@pytest.mark.parametrize(
    ("sampler", "steps", "eta", "published"),
    [("ancestral", 1000, 1, 0.1009), ("ddim", 50, 0, None), ("ddim", 20, 0, None), ("ddim", 50, 1, 0.079)],
)
@pytest.mark.parametrize("objective", process.OBJECTIVES)
def test_gaussian_toy_ends_with_the_samplers_own_spread(sampler, steps, eta, published, objective):
    x = sampled(GAUSSIAN, 20_000, objective, sampler, steps, eta)
    mean, deviation = propagated(sampler, steps, eta)
    if published is not None:
        assert deviation == pytest.approx(published, abs=6e-4)
    assert x.mean().item() == pytest.approx(mean, abs=5 * deviation / 20_000**0.5)
    assert x.std().item() == pytest.approx(deviation, rel=5 / 40_000**0.5)


@pytest.mark.parametrize("sampler", _SAMPLERS)
def test_estimates_of_the_image_are_clipped_where_that_is_wanted(sampler):
    """A network that draws pixels of 3, three times as bright as an image can be."""
    bright = Mixture([1.0], [3.0], [0.1])
    for clip, least, most in ((True, 0.9, 1 + 1e-9), (False, 2.5, 3.5)):
        g = torch.Generator().manual_seed(0)
        noise = iter(lambda g=g: torch.randn(100, 1, 1, 1, generator=g, dtype=torch.float64), None)

        def predict(x, t):
            return bright.answer(x, t, "v")

        *_, x = denoise(predict, SCHEDULE, noise, "v", sampler, clip=clip)
        assert least <= x.min().item() and x.max().item() <= most


# --- two hills: the whole distribution. Each of these tests would raise a false alarm for one seed in a thousand. -----


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sampler", "eta", "objective"),
    [
        ("ancestral", 1.0, "epsilon"),
        ("ancestral", 1.0, "v"),
        ("ddim", 0.0, "epsilon"),
        ("ddim", 1.0, "v"),
        ("dpm-solver++", 0.0, "v"),
    ],
)
def test_a_thousand_steps_draw_from_the_data_distribution(sampler, eta, objective):
    x = sampled(TWO_HILLS, 10_000, objective, sampler, 1000, eta)
    assert kstest(x, TWO_HILLS.cdf).pvalue > 1e-3
    for weights, means in (([0.34, 0.66], [-0.5, 0.4]), ([0.3, 0.7], [-0.5, 0.42])):  # and this size of error is seen
        assert kstest(x, Mixture(weights, means, [0.1, 0.2]).cdf).pvalue < 1e-3


@pytest.mark.parametrize("objective", process.OBJECTIVES)
@pytest.mark.parametrize(("steps", "eta"), [(10, 0.0), (10, 0.5), (10, 1.0), (20, 0.0), (20, 1.0)])
def test_few_ddim_steps_draw_from_their_own_distribution(steps, eta, objective):
    x = sampled(TWO_HILLS, 10_000, objective, "ddim", steps, eta)
    assert kstest(x, ddim_law(TWO_HILLS, _timesteps(1000, steps), eta)).pvalue > 1e-3
    assert kstest(x, TWO_HILLS.cdf).pvalue < 1e-9  # which is not that of the data


def test_with_more_steps_ddim_comes_nearer_to_the_data():
    x = np.linspace(-1, 1, 201)
    steps = (20, 100, 500)
    laws = [ddim_law(TWO_HILLS, _timesteps(1000, n), 0.0)(x) for n in steps]
    off = [np.abs(law - TWO_HILLS.cdf(x)).max() for law in laws]
    assert off[0] > 0.02
    for coarse, fine in pairwise(off):
        assert fine == pytest.approx(coarse / 5, rel=0.15)  # first order in the number of steps


# --- single steps --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", [True, False])
@pytest.mark.parametrize("step", [999, 998, 500, 10, 1, 0])
def test_ancestral_step_agrees_with_diffusers(step, clip):
    theirs = diffusers_scheduler("DDPMScheduler", variance_type="fixed_large", clip_sample=clip)
    g = torch.Generator().manual_seed(0)
    x, answer = torch.randn(2, 3, 1, 4, 4, generator=g, dtype=torch.float64)
    expected = theirs.step(answer, step, x, generator=torch.Generator().manual_seed(7)).prev_sample
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    t = torch.full((3,), step)
    x0 = process.predicted_x0(SCHEDULE, x, t, answer, "epsilon")
    ours = ancestral_step(SCHEDULE, x0.clamp(-1, 1) if clip else x0, x, t, noise)
    torch.testing.assert_close(ours, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("step", [999, 500, 10, 1, 0])
def test_without_clipping_the_ancestral_step_is_equation_10(step):
    x, noise, fresh = torch.randn(3, 2, 1, 4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    t = torch.full((2,), step)
    x0 = process.predicted_x0(SCHEDULE, x, t, noise, "epsilon")
    expected = process.reverse_mean(SCHEDULE, x, t, noise) + (SCHEDULE.betas[step].sqrt() * fresh if step else 0)
    torch.testing.assert_close(ancestral_step(SCHEDULE, x0, x, t, fresh), expected, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("objective", process.OBJECTIVES)
def test_ddim_chain_agrees_with_diffusers(objective, eta):
    options = {"timestep_spacing": "trailing", "prediction_type": PREDICTION_TYPES[objective]}
    theirs = diffusers_scheduler("DDIMScheduler", **options)
    theirs.set_timesteps(20)
    times = _timesteps(1000, 20)
    assert theirs.timesteps.tolist() == times and times[0] == 999
    g = torch.Generator().manual_seed(0)
    for t, before in zip(times, [*times[1:], -1], strict=True):
        x, answer, noise = torch.randn(3, 2, 1, 4, 4, generator=g, dtype=torch.float64)
        expected = theirs.step(
            answer, t, x, eta=eta, use_clipped_model_output=True, variance_noise=noise if eta else None
        ).prev_sample
        x0 = process.predicted_x0(SCHEDULE, x, torch.full((2,), t), answer, objective).clamp(-1, 1)
        torch.testing.assert_close(ddim_step(SCHEDULE, x0, x, t, before, eta, noise), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("steps", [1, 2, 5, 20, 50])
@pytest.mark.parametrize("objective", process.OBJECTIVES)
def test_dpm_solver_agrees_with_diffusers(objective, steps):
    """Every state of the chain, to the single precision in which diffusers computes it (the noise magnifies that)."""
    options = {"timestep_spacing": "trailing", "prediction_type": PREDICTION_TYPES[objective]}
    theirs = diffusers_scheduler("DPMSolverMultistepScheduler", algorithm_type="dpmsolver++", **options)
    theirs.set_timesteps(steps)
    x = torch.randn(100, 1, 1, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def predict(x, t):
        return TWO_HILLS.answer(x, t, objective)

    _, *ours = denoise(predict, SCHEDULE, iter([x]), objective, "dpm-solver++", steps, eta=0, clip=False)
    for t, state in zip(theirs.timesteps, ours, strict=True):
        x = theirs.step(predict(x, [t]), t, x).prev_sample.double()
        torch.testing.assert_close(state, x, rtol=0, atol=2e-4 if objective == "epsilon" else 2e-6)


@pytest.mark.parametrize("objective", process.OBJECTIVES)
def test_dpm_solver_with_noise_agrees_with_diffusers(objective):
    """With η = 1 it solves the stochastic equation; where they extrapolate nothing either, it is DDIM's step."""
    options = {"timestep_spacing": "trailing", "prediction_type": PREDICTION_TYPES[objective]}
    theirs = diffusers_scheduler("DPMSolverMultistepScheduler", algorithm_type="sde-dpmsolver++", **options)
    theirs.set_timesteps(10)
    g = torch.Generator().manual_seed(0)
    x, *noise = torch.randn(11, 100, 1, 1, 1, generator=g, dtype=torch.float64)

    def predict(x, t):
        return TWO_HILLS.answer(x, t, objective)

    _, *ours = denoise(predict, SCHEDULE, iter([x, *noise]), objective, "dpm-solver++", 10, 1.0, clip=False)
    for t, state, fresh in zip(theirs.timesteps, ours, noise, strict=True):
        x = theirs.step(predict(x, [t]), t, x, variance_noise=fresh).prev_sample.double()
        torch.testing.assert_close(state, x, rtol=0, atol=2e-4 if objective == "epsilon" else 2e-6)


def test_dpm_solver_is_of_second_order():
    """For Gaussian data the path from noise to image is known: x keeps its distance from the mean, in deviations."""
    z = torch.linspace(-2, 2, 9, dtype=torch.float64)
    start, end = (GAUSSIAN.noised(SCHEDULE.alpha_bars[t].item()) for t in (800, 200))

    def error(steps, second_order):
        x, last = start.mean + start.stddev * z, None
        for t, earlier in pairwise(np.linspace(800, 200, steps + 1).astype(int).tolist()):
            x0 = GAUSSIAN.expected_x0(x, SCHEDULE.alpha_bars[t].item())
            x = ddim_step(SCHEDULE, _extrapolated(SCHEDULE, x0, t, earlier, last), x, t, earlier)
            last = (t, x0) if second_order else None
        return (x - (end.mean + end.stddev * z)).abs().max().item()

    for steps in (20, 50):
        assert error(steps, False) / error(2 * steps, False) == pytest.approx(2, rel=0.01)  # this is DDIM
        assert error(steps, True) / error(2 * steps, True) == pytest.approx(4, rel=0.05)
    assert error(20, True) < 0.2 * error(20, False)


@pytest.mark.parametrize("crowding", [0.2, 0.7, 1, 1.5, 4])
@pytest.mark.parametrize("steps", [1, 2, 3, 7, 20, 50, 999, 1000])
def test_time_steps_start_at_the_end_and_fall(steps, crowding):
    times = _timesteps(1000, steps, crowding)
    assert _timesteps(1000, 5, 2) == [999, 639, 359, 159, 39]  # 1000 (k / 5)², less one
    assert len(times) == steps and times[0] == 999 and times[-1] >= 0
    assert all(a > b for a, b in pairwise(times))


@pytest.mark.parametrize("steps", [0, 1001])
def test_impossible_number_of_steps(steps):
    with pytest.raises(ValueError, match="steps"):
        _timesteps(1000, steps)


def test_guidance_convention():
    def net(x, t, conditions):
        return torch.full_like(x, 1.0 if conditions is None else 3.0)

    x, y = torch.zeros(1, 1, 2, 2), torch.zeros(1, 1)
    for w, expected in ((0, 1.0), (1, 3.0), (2, 5.0), (0.5, 2.0)):
        assert bool((guided(net, x, None, y, w) == expected).all())


def test_guidance_acts_between_its_times_alone(model, monkeypatch):
    """Where it does not, the strength is 1, and the network is asked once a step instead of twice."""
    asked = []
    net, options = model.net.forward, {"seed": 1, "sampler": "ddim", "steps": 5}  # t / T = 1, 0.8, …, 0.2
    monkeypatch.setattr(model.net, "forward", lambda x, t, y: asked.append(y is not None) or net(x, t, y))
    part = generate(model, TARGETS, guidance=3.0, guided_from=0.4, guided_to=0.8, **options)
    assert len(asked) == 5 + 3 and sum(asked) == 5
    whole, plain = (generate(model, TARGETS, guidance=w, **options) for w in (3.0, 1.0))
    np.testing.assert_array_equal(generate(model, TARGETS, guidance=3.0, guided_to=0.1, **options), plain)
    assert min(np.abs(part - other).max() for other in (whole, plain)) > 1e-3


@pytest.fixture(scope="module")
def model():
    config = TrainingConfig(channels=(4, 8), embedding=16, hidden=8, objective="v", steps=1, T=50)
    net = config.make_net(2)
    with torch.no_grad():  # an untrained network ignores its inputs: its last layers start at zero
        g = torch.Generator().manual_seed(3)
        for p in net.parameters():
            p += 0.1 * torch.randn(p.shape, generator=g)
    return TrainedModel(net, config, np.array([0.0, 10.0]), np.array([1.0, 20.0]))


TARGETS = np.array([[0.1, 12.0], [0.5, 15.0], [0.9, 19.0], [0.3, 11.0], [0.2, 18.0]])


@pytest.mark.parametrize("sampler", ["ddim", "ancestral", "dpm-solver++"])
def test_the_same_seed_gives_the_same_structures_however_they_are_batched(model, sampler):
    images = generate(model, TARGETS, seed=4, sampler=sampler, steps=10)
    assert images.shape == (5, 28, 28) and images.dtype == np.float32
    assert images.min() >= 0 and images.max() <= 1
    np.testing.assert_allclose(
        generate(model, TARGETS, seed=4, sampler=sampler, steps=10, batch_size=2), images, atol=1e-3
    )
    assert np.abs(generate(model, TARGETS, seed=5, sampler=sampler, steps=10) - images).max() > 0.1


def test_a_structure_depends_on_its_own_target_only(model):
    images = generate(model, TARGETS, sampler="ddim", steps=5)
    np.testing.assert_allclose(generate(model, TARGETS[:2], sampler="ddim", steps=5), images[:2], atol=1e-4)
    changed = TARGETS.copy()
    changed[0] = [0.9, 19.5]
    others = generate(model, changed, sampler="ddim", steps=5)
    np.testing.assert_allclose(others[1:], images[1:], atol=1e-4)
    assert np.abs(others[0] - images[0]).max() > 1e-3


def test_trajectory_runs_from_noise_to_the_result(model):
    states = []
    images = generate(model, TARGETS, sampler="ddim", steps=8, trajectory=states, batch_size=2)
    assert len(states) == 9 and all(s.shape == (5, 28, 28) for s in states)
    assert np.std(2 * states[0] - 1) == pytest.approx(1, abs=0.05)
    np.testing.assert_array_equal(states[-1].clip(0, 1), images)


def test_no_targets_give_no_structures(model):
    assert generate(model, np.empty((0, 2))).shape == (0, 28, 28)


def test_targets_outside_the_range_draw_a_warning_that_names_it(model):
    with pytest.warns(UserWarning, match=r"component 1 is 25, seen were 10 to 20"):
        generate(model, [[0.5, 25.0]], sampler="ddim", steps=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"conditions": [[0.5, np.nan]]}, "finite"),
        ({"conditions": [[0.5]]}, r"shape \(m, 2\)"),
        ({"conditions": [0.5, 15.0]}, r"shape \(m, 2\)"),
        ({"sampler": "euler"}, r"ancestral, ddim, dpm-solver\+\+, not 'euler'"),
        ({"steps": 0}, "steps"),
        ({"conditions": [[1.0], [1.0, 2.0]]}, "array of numbers"),
        ({"steps": 2.5}, "steps"),
        ({"steps": "20"}, "steps"),
        ({"eta": 1.5}, "eta"),
        ({"eta": "1"}, "eta"),
        ({"guidance": np.nan}, "guidance"),
        ({"guidance": "2"}, "guidance"),
        ({"guided_from": -0.1}, "guided_from"),
        ({"guided_to": 900}, "guided_to"),
        ({"crowding": 0}, "crowding"),
        ({"batch_size": 0}, "batch_size"),
        ({"batch_size": 1.5}, "batch_size"),
        ({"device": "nonsense"}, "device 'nonsense' cannot be used here"),
    ],
)
def test_bad_input_is_named(model, options, message):
    with pytest.raises(ValueError, match=message):
        generate(model, **{"conditions": TARGETS, "sampler": "ddim"} | options)
