"""Steering a model by a surrogate of the simulation, while it draws.

Classifier guidance (Dhariwal & Nichol 2021) adds the gradient of a second network to each step; diffusion posterior
sampling (Chung et al. 2023) takes that gradient at the estimate of the clean image, x̂₀, where a network that was
trained on clean images can be asked. Here the second network is the surrogate: it predicts the descriptor ŷ of the
structure that x̂₀ is becoming, and x̂₀ is moved against the gradient g of its squared error E = ‖ŷ − y‖² / 2,

    x̂₀ ← x̂₀ − strength · ᾱ · 2 E / ‖g‖² · g.

The step 2 E / ‖g‖² is Polyak's: with one descriptor, and as long as ŷ is linear, it removes the error at once. ᾱ
withholds it while x̂₀ is still a blur. The gradient is not taken through the diffusion model, which would triple the
cost.
"""

import numpy as np
import torch
from torch import Tensor

from inflate_lib._cache import digest
from inflate_lib._checks import choice, number, whole_number
from inflate_lib.alternatives.surrogate import Surrogate, soft_label
from inflate_lib.diffusion import process
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.diffusion.sampling import denoise, guided, noise_images
from inflate_lib.diffusion.schedule import at
from inflate_lib.experiments.run import check_targets, judge_once, model_digest
from inflate_lib.models import Model

_LARGEST = 0.5  # change of a pixel in one step, of the range from −1 to 1


def _correction(x0: Tensor, wanted: Tensor, trained: Surrogate, columns: np.ndarray) -> Tensor:
    """What to add to clean images (n, 1, 28, 28) in [−1, 1] so that the surrogate expects ``wanted`` (n, N) of them.

    ``wanted`` is on the surrogate's own scale: mean 0, standard deviation 1.
    """
    with torch.enable_grad():
        x0 = x0.detach().clone().requires_grad_()
        error = (trained.net(soft_label((x0[:, 0] + 1) / 2))[:, columns] - wanted).square().sum(dim=1) / 2
        (gradient,) = torch.autograd.grad(error.sum(), x0)
    steepness = gradient.square().flatten(1).sum(dim=1).clamp(min=1e-12)
    step = -(2 * error.detach() / steepness)[:, None, None, None] * gradient
    largest = step.abs().flatten(1).amax(dim=1).clamp(min=_LARGEST)
    return step * (_LARGEST / largest)[:, None, None, None]


def steer(
    model: Model,
    told: np.ndarray,
    wanted: np.ndarray,
    trained: Surrogate,
    strength: float = 1.0,
    seed: int = 0,
    start: int = 0,
) -> np.ndarray:
    """Structures drawn under the guidance of a surrogate.

    Parameters
    ----------
    model : inflate_lib.models.Model
        Of a descriptor that the surrogate answers with; its sampler is not the ancestral one.
    told, wanted : (m, N) array_like
        What the model is told, and what the surrogate compares with; they differ where the model is calibrated.
    trained : Surrogate
    strength : float
        0 is plain sampling, the very structures of :func:`inflate_lib.diffusion.generate`.
    seed, start
        As there.

    Returns
    -------
    array, shape (m, 28, 28), float32 in [0, 1]
    """
    number("strength", strength, least=0)
    whole_number("seed", seed, 0)
    whole_number("start", start, 0)
    columns, network = trained.columns(model.name), model.trained
    options = {"sampler": "ddim", "steps": 20, "eta": 1.0, "guidance": 1.0, **model.sampling}
    choice("sampler", options["sampler"], ("ddim", "dpm-solver++"))
    y = torch.from_numpy(network.scaled(np.asarray(told, dtype=float))).float()
    scaled = (np.asarray(wanted, dtype=float) - trained.mean[columns]) / trained.scale[columns]
    scaled = torch.from_numpy(scaled).float()
    net, schedule, objective = network.net.eval(), network.schedule, network.config.objective

    def predict(x, t):
        answer = guided(net, x, t, y, options["guidance"])
        if strength == 0:
            return answer
        x0 = process.predicted_x0(schedule, x, t, answer, objective).clamp(-1, 1)
        trust = at(schedule.alpha_bars, t, x)
        x0 = x0 + strength * trust * _correction(x0, scaled, trained, columns)
        # The answer that belongs to the new estimate: noise and velocity are both linear in it.
        noise = (x - trust.sqrt() * x0) / (1 - trust).sqrt()
        return noise if objective == "epsilon" else trust.sqrt() * noise - (1 - trust).sqrt() * x0

    with torch.no_grad():
        noise = noise_images(seed, range(start, start + len(y)), network.image_size, torch.device("cpu"))
        *_, last = denoise(predict, schedule, noise, objective, options["sampler"], options["steps"], options["eta"])
    return ((last[:, 0] + 1) / 2).clamp(0, 1).numpy()


def run_steered(model, targets, trained, strength, n_per_target, seed, n_jobs=-1):
    """As :func:`inflate_lib.experiments.run.run_experiment`, steered by a surrogate; kept in the cache."""
    targets = check_targets(model.trained, model.name, targets, extrapolate=True)
    level = np.repeat(np.arange(len(targets)), n_per_target)
    told = model.told(model.name, targets)

    def draw(scratch):
        images = [
            steer(model, told[rows], targets[rows], trained, strength, seed_for(seed, model.name), start)
            for start in range(0, len(level), 256)
            for rows in [level[start : start + 256]]
        ]
        return np.concatenate(images)

    key = {
        "model": model_digest(model.trained),
        "surrogate": digest(*(value.numpy() for _, value in sorted(trained.net.state_dict().items()))),
        "told": digest(told),
        "strength": strength,
        "sampling": model.sampling,
        "seed": seed,
    }
    return judge_once("alternative", draw, model.name, targets, level, key, n_jobs)
