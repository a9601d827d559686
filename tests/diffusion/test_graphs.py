"""Captured steps, as far as a CPU can tell: what they learn is what the plain loop learns, to the last bit."""

import time

import numpy as np
import pytest
import torch

from inflate_lib.diffusion import TrainedModel, TrainingConfig, train
from inflate_lib.diffusion.graphs import CapturedRun

SMALL = {"channels": (4, 8), "embedding": 16, "hidden": 8, "batch_size": 8, "steps": 8, "log_every": 1, "device": "cpu"}
PAPER = TrainingConfig(**SMALL, learning_rate=1e-3)
LAPTOP = {"objective": "v", "timestep_draws": 2, "ema_decay": 0.9, "warmup_steps": 2, "learning_rate_decay": "cosine"}
OTHER = TrainingConfig(**SMALL, learning_rate=1e-3, parts=(1, 1), **LAPTOP)


@pytest.fixture(scope="module")
def pairs():
    """Twenty: every third batch of eight is smaller."""
    rng = np.random.default_rng(0)
    return rng.integers(0, 256, (20, 8, 8), np.uint8), rng.random((20, 2))


def captured(*arguments):
    run = CapturedRun(*arguments)
    run.capture()
    return run


def same(one, other):
    pairs = zip(one.net.state_dict().values(), other.net.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("config", [PAPER, OTHER], ids=["paper", "other"])
def test_the_loss_is_that_of_the_plain_loop_step_by_step(pairs, config, monkeypatch):
    computed = []
    compute = CapturedRun.compute
    monkeypatch.setattr(CapturedRun, "compute", lambda run: computed.append(run.step) or compute(run))
    run = captured(*pairs, config)
    run.run(progress=False)
    assert computed == [0, 1, 3, 4, 6, 7]  # what a graph would replay; the smaller batches go through the plain loop
    model, plain = run.model(), train(*pairs, config, progress=False)
    assert model.history == plain.history and len(set(plain.history["loss"])) == 8
    assert same(model, plain)


def test_a_run_stops_in_time_and_goes_on_exactly_where_it_was(pairs, tmp_path):
    for steps in (1, 2, 3):  # there is time for one step only
        run = captured(*pairs, OTHER, tmp_path)
        run.until = time.monotonic()
        run.run(progress=False)
        assert run.step == steps
    run = captured(*pairs, OTHER, tmp_path)
    run.run(progress=False)
    assert run.step == 8 and same(run.model(), train(*pairs, OTHER, progress=False))


def test_a_run_goes_on_from_weights_alone(pairs, tmp_path):
    run = captured(*pairs, PAPER)
    run.until = time.monotonic()
    run.run(progress=False)
    run.model().save(tmp_path / "model.safetensors", half=True)
    stopped = TrainedModel.load(tmp_path / "model.safetensors")
    run = captured(*pairs, PAPER, tmp_path, stopped)
    assert run.step == 1 and run.rate() == PAPER.learning_rate / 500  # Adam's moments are gone: a warm-up
    assert all(torch.equal(a, b) for a, b in zip(run.parameters, stopped.net.parameters(), strict=True))
    run.run(progress=False)
    assert run.history["step"] == list(range(1, 9))
    with pytest.raises(ValueError, match="belongs to a run with another configuration"):
        captured(*pairs, PAPER, tmp_path).run(progress=False)  # no start: not the run whose checkpoint is there
    with pytest.raises(ValueError, match="another recipe or other data"):
        CapturedRun(*pairs, OTHER, tmp_path, stopped)
