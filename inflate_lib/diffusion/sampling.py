"""Sampling: from noise and a target descriptor to structures (section 2.3), by 1000 ancestral steps or by few.

The network's answer is first turned into an estimate of the clean image, which is clipped to [−1, 1]; every sampler
then steps from x_t and that estimate. Without clipping, the ancestral one is Eq. 10 to the letter.
"""

import warnings
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from inflate_lib._checks import choice, number, numbers, positive_number, share, whole_number
from inflate_lib.diffusion import process
from inflate_lib.diffusion.model import TrainedModel
from inflate_lib.diffusion.randomness import random_generator
from inflate_lib.diffusion.schedule import Schedule, at
from inflate_lib.diffusion.training import choose_device

_SAMPLERS = ("ancestral", "ddim", "dpm-solver++")


def _timesteps(T: int, steps: int, crowding: float = 1.0) -> list[int]:
    """Zero-based time steps of a sampler with ``steps`` steps, *down from the last*, T − 1: T (k / steps)^crowding.

    With crowding 1 this is the even spacing called "trailing": a sampler must begin where its input, pure noise,
    belongs. Above 1 the steps crowd near the image, below 1 near the noise.
    """
    whole_number("steps", steps, 1, T)
    positive_number("crowding", crowding)
    times = np.round(T * (np.arange(steps, 0, -1) / steps) ** crowding)
    # No two alike: a step that rounds onto its neighbour moves to the next free time.
    times = np.maximum(times, np.arange(steps, 0, -1))
    return (np.minimum(times, T - np.arange(steps)).astype(int) - 1).tolist()


def ancestral_step(schedule: Schedule, x0: Tensor, x: Tensor, t: Tensor, noise: Tensor) -> Tensor:
    """Draw x_{t-1} from p_θ (Eq. 9), with σ² = β and an estimate of x₀; the last step (t = 0) adds no noise."""
    deviation = schedule.betas.sqrt() * (torch.arange(len(schedule)) > 0)
    return process.posterior_mean(schedule, x0, x, t) + at(deviation, t, x) * noise


def ddim_step(
    schedule: Schedule,
    x0: Tensor,
    x: Tensor,
    t: int,
    previous: int,
    eta: float = 0.0,
    noise: Tensor | None = None,
) -> Tensor:
    """Step from time t to any earlier one, ``previous`` (−1 is the clean image), as Song et al. (2021, Eq. 12) do.

    ``eta`` 0 is deterministic; 1 adds as much noise as the exact posterior between the two times has.
    """
    now = schedule.alpha_bars[t]
    before = schedule.alpha_bars[previous] if previous >= 0 else torch.ones_like(now)
    variance = eta**2 * (1 - before) / (1 - now) * (1 - now / before)
    # (x − √ᾱ x₀) / √(1 − ᾱ) is the noise that belongs to the (clipped) estimate of x₀.
    on_noise = ((1 - before - variance).clamp(min=0) / (1 - now)).sqrt()
    on_x0 = before.sqrt() - on_noise * now.sqrt()
    stepped = on_x0.item() * x0 + on_noise.item() * x
    return stepped if noise is None or eta == 0 else stepped + variance.sqrt().item() * noise


def _extrapolated(schedule: Schedule, x0: Tensor, t: int, previous: int, last: tuple[int, Tensor] | None) -> Tensor:
    """The estimate of x₀ with which a DDIM step is one of DPM-Solver++(2M) (Lu et al. 2022, algorithm 2), or its SDE.

    It is extrapolated half a step along ln SNR, from the one made at the step before: ``last`` is that step's time and
    estimate. The first step has none, and the last one, to the clean image, would be infinitely long on this scale:
    they are plain DDIM.
    """
    if last is None or previous < 0:
        return x0
    log_snr = schedule.signal_to_noise.log()
    ratio = (log_snr[previous] - log_snr[t]) / (log_snr[t] - log_snr[last[0]])
    return x0 + ratio.item() / 2 * (x0 - last[1])


def guided(net: Callable, x: Tensor, t: Tensor, conditions: Tensor, guidance: float) -> Tensor:
    """Classifier-free guidance: u + w (c − u), c and u being the answers with and without the descriptor.

    w = 1 is plain conditional sampling (the paper's strength), w = 0 ignores the descriptor, w > 1 exaggerates it.
    A network that is told w answers so by itself, at once.
    """
    if getattr(net, "strength", None) is not None:
        return net(x, t, conditions, guidance=torch.full((len(x),), float(guidance), device=x.device))
    if guidance == 1:
        return net(x, t, conditions)
    without = net(x, t, None)
    return without if guidance == 0 else without + guidance * (net(x, t, conditions) - without)


def denoise(
    predict: Callable,
    schedule: Schedule,
    noise: Iterator[Tensor],
    objective: str,
    sampler: str = "ancestral",
    steps: int = 20,
    eta: float = 1.0,
    clip: bool = True,
    crowding: float = 1.0,
) -> Iterator[Tensor]:
    """The reverse process, one state after another: x_T first, x_0 last.

    Parameters
    ----------
    predict : callable
        ``predict(x, t)`` with t (n,) → the network's answer.
    noise : iterator of Tensor
        Standard normal tensors, the first of which is x_T.
    sampler, steps, eta, crowding
        As in ``generate``.
    clip : bool
        Clip the estimates of x₀ to [−1, 1].
    """
    choice("sampler", sampler, _SAMPLERS)
    T = len(schedule)
    times = _timesteps(T, T) if sampler == "ancestral" else _timesteps(T, steps, crowding)
    x, last = next(noise), None
    yield x
    for time, previous in zip(times, times[1:] + [-1], strict=True):
        t = torch.full((len(x),), time)
        x0 = process.predicted_x0(schedule, x, t, predict(x, t), objective)
        x0 = x0.clamp(-1, 1) if clip else x0
        if sampler == "ancestral":
            x = ancestral_step(schedule, x0, x, t, next(noise))
        else:
            fresh = next(noise) if eta > 0 else None
            x = ddim_step(schedule, _extrapolated(schedule, x0, time, previous, last), x, time, previous, eta, fresh)
            last = (time, x0) if sampler == "dpm-solver++" else None
        yield x


def generate(
    model: TrainedModel,
    conditions: np.ndarray,
    seed: int = 0,
    sampler: str = "ancestral",
    steps: int = 20,
    eta: float = 1.0,
    guidance: float = 1.0,
    guided_from: float = 0.0,
    guided_to: float = 1.0,
    crowding: float = 1.0,
    steering: float = 0.0,
    batch_size: int = 256,
    trajectory: list | None = None,
    device: str = "auto",
    start: int = 0,
) -> np.ndarray:
    """Generate one structure for each target descriptor.

    Parameters
    ----------
    model : TrainedModel
    conditions : array, shape (m, N) or (m,)
        Targets in raw units. One outside the range seen in training draws a warning. A model of several parts
        (``TrainingConfig.parts``) takes NaN for those that are not asked for.
    seed : int
        Structure i depends on the seed, on i and on its own target alone, not on the batch size.
    sampler : "ancestral", "ddim" or "dpm-solver++"
        All T steps with σ² = β (paper), or ``steps`` steps of DDIM or of the second-order DPM-Solver++(2M), each with
        noise of its own as ``eta`` says.
    steps : int
        Number of steps; the ancestral sampler ignores it and takes all T.
    eta : float
        Noise between 0 (deterministic) and 1 (as much as the exact posterior has); the ancestral sampler ignores it.
    guidance : float
        w of u + w (c − u): 1 is plain conditional (paper), 0 unconditional. A model into which guidance was distilled
        takes what it was trained for (``TrainingConfig.strongest``), and half as long.
    guided_from, guided_to : float
        Guide at times t/T between these two alone; elsewhere w = 1, which costs half (Kynkäänniemi et al. 2024).
    crowding : float
        1 spaces the steps evenly; above it they crowd near the image, below it near the noise.
    steering : float
        Strength γ of the corrections of the model's ``judge``; 0 is without. Each estimate x̂₀ of the clean image
        becomes x̂₀ + γ ᾱ · judge(x̂₀, y): little where it is still a blur, all where the noise is gone. What is drawn
        in the end, the judge finishes.
    batch_size : int
        Structures denoised at a time.
    trajectory : list, optional
        Filled with every state of the reverse process, noise first: arrays (m, h, w) on the scale of the images,
        not clipped.
    device : str
        As in ``TrainingConfig``.
    start : int
        Number of the first structure: structures can be made in several calls, and come out the same.

    Returns
    -------
    array, shape (m, h, w), or (m, c, h, w) where images have c > 1 channels; float32 in [0, 1]

    Raises
    ------
    ValueError
        Wrong number of descriptors, or one that is not finite; unknown sampler; impossible number of steps.
    """
    share("eta", eta)
    number("guidance", guidance)
    share("guided_from", guided_from)
    share("guided_to", guided_to)
    whole_number("batch_size", batch_size, 1)
    whole_number("seed", seed, 0)
    whole_number("start", start, 0)
    whole_number("steps", steps, 1)
    positive_number("crowding", crowding)
    number("steering", steering, least=0)
    judge = model.judge
    if steering and judge is None:
        raise ValueError("steering: this model has no judge to steer it")
    if model.config.strongest and not 1 <= guidance <= model.config.strongest:
        raise ValueError(
            f"guidance must be from 1 to {model.config.strongest:g}, which is what this model was told in training, "
            f"not {guidance:g}"
        )
    scaled = torch.from_numpy(model.scaled(_checked(model, conditions))).float()
    place = choose_device(device)
    net, shape = model.net.to(place).eval(), (model.config.image_channels, *model.image_size)
    states = []
    for first in range(0, len(scaled), batch_size):
        rows = range(first, min(first + batch_size, len(scaled)))
        y = scaled[rows.start : rows.stop].to(place)

        def predict(x, t, y=y, judge=judge):
            inside = guided_from <= (t[0].item() + 1) / len(model.schedule) <= guided_to
            answer = guided(net, x, t.to(place), y, guidance if inside else 1)
            if not steering:
                return answer
            return _corrected(model, x, t, answer, lambda x0: steering * judge(x0.cpu(), y.cpu()).to(place))

        with torch.inference_mode():
            noise = noise_images(seed, range(start + rows.start, start + rows.stop), shape, place)
            states.append([])
            for x in denoise(
                predict, model.schedule, noise, model.config.objective, sampler, steps, eta, crowding=crowding
            ):
                if trajectory is None:
                    states[-1].clear()  # only the last state is wanted
                states[-1].append(x.squeeze(1).cpu())
            if steering and judge:
                states[-1][-1] = judge.finish(x.cpu().clamp(-1, 1), y.cpu()).squeeze(1)
    net.cpu()
    merged = [((torch.cat(batches) + 1) / 2).numpy() for batches in zip(*states, strict=True)]
    if trajectory is not None:
        trajectory.extend(merged)
    return merged[-1].clip(0, 1) if merged else torch.empty(0, *shape).squeeze(1).numpy()


def _corrected(model: TrainedModel, x: Tensor, t: Tensor, answer: Tensor, correction: Callable) -> Tensor:
    """The network's answer as it would be for a corrected estimate of the clean image: noise and velocity are both
    linear in it."""
    objective, alpha_bar = model.config.objective, at(model.schedule.alpha_bars, t, x)
    x0 = process.predicted_x0(model.schedule, x, t, answer, objective).clamp(-1, 1)
    x0 = x0 + alpha_bar * correction(x0)
    noise = (x - alpha_bar.sqrt() * x0) / (1 - alpha_bar).sqrt()
    return noise if objective == "epsilon" else alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * x0


def noise_images(seed: int, rows: range, shape: tuple[int, ...], device: torch.device) -> Iterator[Tensor]:
    """Standard normal images (n, c, h, w) without end, each row from a generator of its own; `shape` is (c, h, w)."""
    generators = [random_generator(seed, 3, row) for row in rows]
    while True:
        yield torch.stack([torch.randn(shape, generator=g) for g in generators]).to(device)


def _checked(model: TrainedModel, conditions: np.ndarray) -> np.ndarray:
    conditions = numbers("conditions", conditions, "an array of numbers", finite=False)
    wanted = len(model.condition_min)
    if conditions.ndim == 1 and wanted == 1:
        conditions = conditions[:, None]
    if conditions.ndim != 2 or conditions.shape[1] != wanted:
        raise ValueError(f"this model takes conditions of shape (m, {wanted}), not {conditions.shape}")
    asked = np.ones_like(conditions, dtype=bool)
    if model.config.parts:  # a part is asked for as a whole
        starts = np.cumsum((0, *model.config.parts[:-1]))
        asked = np.repeat(~np.isnan(conditions[:, starts]), model.config.parts, axis=1)
    if not np.array_equal(np.isfinite(conditions), asked):
        raise ValueError("conditions must be finite" + ", or NaN in a whole part" * bool(model.config.parts))
    slack = 1e-9 * np.maximum(1, np.abs(model.condition_max))
    outside = (conditions < model.condition_min - slack) | (conditions > model.condition_max + slack)
    if outside.any():
        j = int(np.argmax(outside.any(axis=0)))
        worst = conditions[np.argmax(outside[:, j]), j]
        warnings.warn(
            f"{int(outside.any(axis=1).sum())} of {len(conditions)} conditions lie outside the range of the training "
            f"data: component {j} is {worst:.4g}, seen were {model.condition_min[j]:.4g} to "
            f"{model.condition_max[j]:.4g}. Expect poor structures.",
            stacklevel=3,
        )
    return conditions
