"""Samplers against exact Gaussian results and diffusers; generate()'s promises."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from inflate_lib.diffusion import TrainedModel, TrainingConfig, cosine_schedule, generate, process
from inflate_lib.diffusion.sampling import ancestral_step, ddim_step, denoise, guided, timesteps

SCHEDULE = cosine_schedule()
MEAN, DEVIATION = 0.2, 0.1  # of the Gaussian toy


def exact_answer(x, t, objective):
    """What a perfect network answers for Gaussian data: the conditional expectation of noise, or of velocity."""
    left = SCHEDULE.alpha_bars[t[0]].item()
    noise = (x - left**0.5 * MEAN) * (1 - left) ** 0.5 / (left * DEVIATION**2 + 1 - left)
    if objective == "epsilon":
        return noise
    x0 = MEAN + left**0.5 * DEVIATION**2 / (left * DEVIATION**2 + 1 - left) * (x - left**0.5 * MEAN)
    return left**0.5 * noise - (1 - left) ** 0.5 * x0


def propagated(sampler, steps, eta):
    """Mean and deviation that the sampler must end with: its update is linear, so both follow exactly."""
    times = timesteps(1000, steps)
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
    g = torch.Generator().manual_seed(1)
    shape = (20_000, 1, 1, 1)
    noise = iter(lambda: torch.randn(shape, generator=g, dtype=torch.float64), None)
    chain = denoise(
        lambda x, t: exact_answer(x, t, objective), SCHEDULE, noise, objective, sampler, steps, eta, clip=False
    )
    *_, x = chain
    mean, deviation = propagated(sampler, steps, eta)
    if published is not None:
        assert deviation == pytest.approx(published, abs=6e-4)
    assert x.mean().item() == pytest.approx(mean, abs=5 * deviation / 20_000**0.5)
    assert x.std().item() == pytest.approx(deviation, rel=5 / 40_000**0.5)


@pytest.mark.parametrize("clip", [True, False])
@pytest.mark.parametrize("step", [998, 500, 10, 1, 0])
def test_ancestral_step_agrees_with_diffusers(step, clip):
    diffusers = pytest.importorskip("diffusers")
    theirs = diffusers.DDPMScheduler(beta_schedule="squaredcos_cap_v2", variance_type="fixed_large", clip_sample=clip)
    g = torch.Generator().manual_seed(0)
    x, answer = torch.randn(2, 3, 1, 4, 4, generator=g)
    expected = theirs.step(answer, step, x, generator=torch.Generator().manual_seed(7)).prev_sample
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(7))
    t = torch.full((3,), step)
    x0 = process.predicted_x0(SCHEDULE, x, t, answer, "epsilon")
    ours = ancestral_step(SCHEDULE, x0.clamp(-1, 1) if clip else x0, x, t, noise)
    torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-3 if step == 998 else 1e-4)


@pytest.mark.parametrize("eta", [0.0, 1.0])
@pytest.mark.parametrize("objective", process.OBJECTIVES)
def test_ddim_chain_agrees_with_diffusers(objective, eta):
    diffusers = pytest.importorskip("diffusers")
    theirs = diffusers.DDIMScheduler(
        beta_schedule="squaredcos_cap_v2",
        timestep_spacing="trailing",
        prediction_type="epsilon" if objective == "epsilon" else "v_prediction",
    )
    theirs.set_timesteps(20)
    times = timesteps(1000, 20)
    assert theirs.timesteps.tolist() == times and times[0] == 999
    g = torch.Generator().manual_seed(0)
    for t, before in zip(times, [*times[1:], -1], strict=True):
        x, answer, noise = torch.randn(3, 2, 1, 4, 4, generator=g)
        expected = theirs.step(
            answer, t, x, eta=eta, use_clipped_model_output=True, variance_noise=noise if eta else None
        ).prev_sample
        x0 = process.predicted_x0(SCHEDULE, x, torch.full((2,), t), answer, objective).clamp(-1, 1)
        torch.testing.assert_close(ddim_step(SCHEDULE, x0, x, t, before, eta, noise), expected, rtol=1e-4, atol=1e-4)


def test_full_length_ddim_with_eta_one_is_the_ancestral_sampler_with_the_posterior_variance():
    g = torch.Generator().manual_seed(0)
    x0, x = torch.randn(2, 3, 1, 4, 4, generator=g, dtype=torch.float64)
    for t in (1, 30, 999):
        stepped = ddim_step(SCHEDULE, x0, x, t, t - 1, 1.0, torch.zeros_like(x))
        torch.testing.assert_close(stepped, process.posterior_mean(SCHEDULE, x0, x, torch.full((3,), t)))


@pytest.mark.parametrize("steps", [1, 2, 3, 7, 20, 50, 999, 1000])
def test_time_steps_start_at_the_end_and_fall(steps):
    times = timesteps(1000, steps)
    assert len(times) == steps and times[0] == 999 and times[-1] >= 0
    assert all(a > b for a, b in pairwise(times))


@pytest.mark.parametrize("steps", [0, 1001])
def test_impossible_number_of_steps(steps):
    with pytest.raises(ValueError, match="steps"):
        timesteps(1000, steps)


def test_guidance_convention():
    def net(x, t, conditions):
        return torch.full_like(x, 1.0 if conditions is None else 3.0)

    x, y = torch.zeros(1, 1, 2, 2), torch.zeros(1, 1)
    for w, expected in ((0, 1.0), (1, 3.0), (2, 5.0), (0.5, 2.0)):
        assert bool((guided(net, x, None, y, w) == expected).all())


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


@pytest.mark.parametrize("sampler", ["ddim", "ancestral"])
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
        ({"sampler": "euler"}, "'euler'"),
        ({"steps": 0}, "steps"),
        ({"conditions": [[1.0], [1.0, 2.0]]}, "array of numbers"),
        ({"steps": 2.5}, "steps"),
        ({"steps": "20"}, "steps"),
        ({"eta": 1.5}, "eta"),
        ({"eta": "1"}, "eta"),
        ({"guidance": np.nan}, "guidance"),
        ({"guidance": "2"}, "guidance"),
        ({"batch_size": 0}, "batch_size"),
        ({"batch_size": 1.5}, "batch_size"),
        ({"device": "nonsense"}, "device 'nonsense' cannot be used here"),
    ],
)
def test_bad_input_is_named(model, options, message):
    with pytest.raises(ValueError, match=message):
        generate(model, **{"conditions": TARGETS, "sampler": "ddim"} | options)
