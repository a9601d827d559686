"""The training loop of every network: it learns, goes on where it was, and says where it is lost."""

import subprocess
import sys

import pytest
import torch

from inflate_lib.diffusion.loop import fit
from inflate_lib.diffusion.randomness import initialised


def test_a_network_learns_a_linear_map():
    """The training loop, on a problem with a known answer."""
    weights = torch.randn(6, 2)
    x = torch.randn(500, 6)
    y = x @ weights
    net = initialised(lambda: torch.nn.Linear(6, 2), seed=0)
    history, _ = fit(net, lambda rows, _: (net(x[rows]) - y[rows]).square().mean(), 500, 600, 64, 0.05)
    torch.testing.assert_close(net.weight.T, weights, atol=1e-2, rtol=0)
    assert history[-1] < 1e-4 * history[0] and len(history) == 20


def test_training_that_was_interrupted_ends_as_if_it_had_not_been(tmp_path):
    x = torch.randn(50, 3)

    def trained(folder, stop=None):
        net = initialised(lambda: torch.nn.Linear(3, 1), seed=0)
        calls = []

        def loss(rows, generator):
            calls.append(1)
            if len(calls) == stop:
                raise KeyboardInterrupt
            return (net(x[rows]) + torch.randn(1, generator=generator)).square().mean()

        history, _ = fit(net, loss, 50, 40, 8, 0.05, seed=5, folder=folder)
        return net.weight.detach().clone(), history, len(calls)

    whole = trained(None)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, stop=24)
    weights, history, calls = trained(tmp_path)
    assert calls == 40 - 22  # the last checkpoint was after 22 steps
    assert torch.equal(weights, whole[0]) and history == whole[1]


def test_a_loss_that_is_lost_is_an_error():
    net = torch.nn.Linear(1, 1)
    with pytest.raises(FloatingPointError, match="the training loss became nan between steps 0 and 1"):
        fit(net, lambda rows, _: net.weight.sum() * torch.nan, 5, 20)


def test_training_loads_no_compiler():
    """It would take a process longer than many a training here."""
    code = """
import sys, torch
from inflate_lib.diffusion.loop import fit
net = torch.nn.Linear(1, 1)
fit(net, lambda rows, _: net(rows[:, None].float()).square().mean(), n=8, steps=2)
assert "torch._dynamo" not in sys.modules
"""
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stderr == ""
