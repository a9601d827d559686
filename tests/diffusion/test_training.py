"""Training: learns, repeats itself to the last bit, survives a kill, refuses what it cannot use."""

import copy
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate, process, storage, train
from inflate_lib.diffusion.loop import Loop, _Log
from inflate_lib.diffusion.randomness import random_generator
from inflate_lib.diffusion.training import Run, choose_device, losses_in_time

TINY = {"channels": (4, 8), "embedding": 16, "hidden": 8, "batch_size": 8, "learning_rate": 1e-3}


def config(**options):
    return TrainingConfig(**{**TINY, "steps": 24, "checkpoint_every": 8, "log_every": 3, "ema_decay": 0.9} | options)


def data(n=20, n_conditions=2, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (n, 28, 28), dtype=np.uint8), rng.random((n, n_conditions)) * 5 + 3


class Interrupt(Exception):
    pass


def interrupt_at(monkeypatch, step):
    """Make training fail as it starts this step; from outside nothing can happen between two steps."""
    from inflate_lib.diffusion.training import Run

    advance = Run.advance

    def interrupted(self):
        if self.step == step:
            raise Interrupt
        advance(self)

    monkeypatch.setattr(Run, "advance", interrupted)


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a.net.state_dict().values(), b.net.state_dict().values(), strict=True))


def test_the_same_seed_repeats_itself_and_another_does_not():
    first, second, other = (train(*data(), config(seed=s), progress=False, threads=1) for s in (1, 1, 2))
    assert first.history == second.history and same(first, second)
    assert first.history["loss"] != other.history["loss"]


@pytest.mark.parametrize("step", [3, 8, 13, 23])
def test_an_interrupted_run_goes_on_as_if_nothing_had_happened(tmp_path, monkeypatch, step):
    whole = train(*data(), config(learning_rate_decay="cosine"), tmp_path / "whole", progress=False, threads=1)
    with monkeypatch.context() as patch:
        interrupt_at(patch, step)
        with pytest.raises(Interrupt):
            train(*data(), config(learning_rate_decay="cosine"), tmp_path / "cut", progress=False, threads=1)
    resumed = train(*data(), config(learning_rate_decay="cosine"), tmp_path / "cut", progress=False, threads=1)
    assert resumed.history == whole.history  # to the last bit
    assert same(resumed, whole)


def test_a_finished_run_is_not_repeated(tmp_path, monkeypatch):
    first = train(*data(), config(), tmp_path, progress=False, threads=1)
    interrupt_at(monkeypatch, 0)
    assert same(train(*data(), config(), tmp_path, progress=False, threads=1), first)


CHILD = """
import os, resource, signal, sys
sys.path.insert(0, sys.argv[2])
from test_training import config, data, die, storage, train, TINY
from inflate_lib.diffusion.training import Run

{}
train(*data(), config(learning_rate_decay="cosine"), sys.argv[1], progress=False, threads=1)
"""
DEATHS = {
    "before the first checkpoint": "die(Run, 'advance', lambda run: run.step == 5)",
    "with half a checkpoint written": """
save = storage.save
storage.save = lambda *content, **more: save(*content, **more)[:1000]  # the first part of the bytes reaches the disk
die(os, 'fsync', lambda file: True)""",
    "before the new checkpoint is in place": "die(os, 'replace', lambda old, new: True)",
    "with half of the second written": """
save, saved = storage.save, []
def cut(*content, **more):
    saved.append(0)
    return save(*content, **more)[: 1000 if len(saved) == 2 else None]
storage.save = cut
die(os, 'fsync', lambda file: len(saved) == 2)""",
    "in the last step": "die(Run, 'advance', lambda run: run.step == 23)",
}


def die(place, name, now):
    """Let the process be killed with SIGKILL as it enters a function, when ``now`` says so."""
    call = getattr(place, name)

    def deadly(*arguments):
        if now(*arguments):
            os.kill(os.getpid(), signal.SIGKILL)
        return call(*arguments)

    setattr(place, name, deadly)


def child(folder, preparation):
    command = [sys.executable, "-c", CHILD.format(preparation), str(folder), os.path.dirname(__file__)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
def test_a_run_killed_again_and_again_ends_as_if_nothing_had_happened(tmp_path):
    reached = []
    for moment, preparation in DEATHS.items():
        ended = child(tmp_path, preparation)
        assert ended.returncode == -signal.SIGKILL, (moment, ended.stderr)
        there = (tmp_path / Loop.checkpoint).exists()
        reached.append(storage.read(tmp_path / Loop.checkpoint, "checkpoint")[1]["step"] if there else 0)
    assert reached == [0, 0, 0, 8, 16]  # the last checkpoint that was whole
    killed = train(*data(), config(learning_rate_decay="cosine"), tmp_path, progress=False, threads=1)
    whole = train(*data(), config(learning_rate_decay="cosine"), progress=False, threads=1)
    assert killed.history == whole.history  # to the last bit
    assert same(killed, whole)
    assert os.listdir(tmp_path) == [Loop.checkpoint]  # nothing half-written is left


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
@pytest.mark.parametrize(
    ("step", "kept"), [(0, "step 8 (there is no checkpoint yet)"), (8, "step 16 (the checkpoint before it is kept)")]
)
def test_a_full_disk_stops_with_a_message_and_keeps_the_old_checkpoint(step, kept, tmp_path):
    """The limit on the size of a file stands in for the disk: the next checkpoint meets it in the middle."""
    limit = f"""
def full(run):
    if run.step == {step}:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
die(Run, 'advance', full)"""
    ended = child(tmp_path, limit)
    assert ended.returncode == 1
    assert f"File too large at {kept}" in ended.stderr.splitlines()[-1]
    assert os.listdir(tmp_path) == [Loop.checkpoint] * (step > 0)
    if step:
        assert storage.read(tmp_path / Loop.checkpoint, "checkpoint")[1]["step"] == step


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    train(*data(), config(), tmp_path, progress=False, threads=1)
    for images, conditions, options in ((*data(), {"seed": 3}), (*data(seed=9), {})):
        with pytest.raises(ValueError, match="another configuration or other data"):
            train(images, conditions, config(**options), tmp_path, progress=False)


def test_weights_that_are_lost_in_the_very_last_step_are_not_saved(tmp_path, monkeypatch):
    from inflate_lib.diffusion.training import Run

    advance = Run.advance

    def explode(self):
        advance(self)
        if self.step == 16:  # the loss of this step was still finite
            with torch.no_grad():
                self.net.out.bias.fill_(float("inf"))

    monkeypatch.setattr(Run, "advance", explode)  # healthy data do not lose a network, least of all at a given step
    with pytest.raises(FloatingPointError, match=r"weights are no longer finite after step 16"):
        train(*data(), config(), tmp_path, progress=False, threads=1)
    assert storage.read(tmp_path / Loop.checkpoint, "checkpoint")[1]["step"] == 8


def test_a_lost_loss_stops_training_and_keeps_the_last_good_state(tmp_path, monkeypatch):
    from inflate_lib.diffusion.training import Run

    advance = Run.advance

    def explode(self):
        if self.step == 12:
            with torch.no_grad():
                self.net.out.bias.fill_(float("nan"))
        advance(self)

    monkeypatch.setattr(Run, "advance", explode)  # healthy data do not lose a network, least of all at a given step
    with pytest.raises(FloatingPointError, match=r"loss became nan between steps 12 and 15.*last good state"):
        train(*data(), config(), tmp_path, progress=False, threads=1)
    tensors, content = storage.read(tmp_path / Loop.checkpoint, "checkpoint")
    assert content["step"] == 8 and all(bool(torch.isfinite(v).all()) for v in tensors.values())


@pytest.mark.slow
def test_learns_sixteen_structures_by_heart():
    """A bar at one of eight heights, on the left or on the right: the answer must put it where it is wanted."""
    targets = np.array([(height, side) for height in range(1, 9) for side in (0, 1)], dtype=float)
    images = np.zeros((16, 14, 14), np.uint8)
    for image, (height, side) in zip(images, targets.astype(int), strict=True):
        image[height : height + 3, 7 * side : 7 * side + 6] = 255
    options = {"channels": (16, 32), "embedding": 64, "hidden": 64, "batch_size": 32, "learning_rate": 4e-3}
    options |= {"objective": "v", "ema_decay": 0.98, "learning_rate_decay": "cosine", "log_every": 50}
    budget = config(**options, steps=400, checkpoint_every=1000)
    model = train(np.repeat(images, 2, 0), np.repeat(targets, 2, 0), budget, progress=False, threads=1)
    assert model.history["simple"][-1] < 0.25 * model.history["simple"][0]

    def off(made):
        return np.abs(made - images / 255).mean()

    assert off(generate(model, targets, sampler="ddim", steps=20)) < 0.1
    assert off(generate(model, targets, sampler="ddim", steps=20, guidance=0)) > 0.15  # it was not told


@pytest.mark.parametrize(
    "options",
    [
        {"objective": "epsilon"},
        {"objective": "v", "min_snr": 5.0, "timestep_draws": 2},
        {"warmup_steps": 4, "learning_rate_decay": "cosine", "ema_decay": 0.9},
    ],
)
def test_the_loop_is_the_textbooks(options):
    """The same random numbers in a plain loop, which is written down from the definitions: losses and answers agree.

    Three batches to an epoch, the last one half as large; every second descriptor is withheld.
    """
    images, conditions = data(20)
    given = config(**{"ema_decay": 0.0, "steps": 7, "log_every": 1, "condition_dropout": 0.5} | options)
    model = train(images, conditions, given, progress=False, threads=1)

    net, bars = given.make_net(2), model.schedule.alpha_bars
    optimiser = torch.optim.Adam(net.parameters(), lr=given.learning_rate)
    average = [p.detach().clone() for p in net.parameters()]
    scaled = (conditions - conditions.min(0)) / (conditions.max(0) - conditions.min(0))
    snr, losses = bars / (1 - bars), []
    for step in range(7):
        epoch, batch = divmod(step, 3)
        order = torch.randperm(20, generator=random_generator(0, 1, epoch))
        rows = order[8 * batch : 8 * batch + 8].numpy()
        generator, n = random_generator(0, 2, step), len(rows)
        t = torch.randint(1000, (given.timestep_draws, n), generator=generator).amax(0)
        dropped = torch.rand(n, generator=generator) < 0.5
        noise = torch.randn(n, 1, 28, 28, generator=generator)
        x0 = torch.from_numpy(images[rows] / 127.5 - 1).float()[:, None]
        signal, spread = (of.sqrt().float()[t].reshape(-1, 1, 1, 1) for of in (bars, 1 - bars))
        y = torch.from_numpy(scaled[rows]).float()
        answer = net(signal * x0 + spread * noise, t, y, dropped)
        target = noise if given.objective == "epsilon" else signal * noise - spread * x0
        weight = torch.ones(1000, dtype=torch.float64)
        if given.min_snr > 0:
            weight = torch.minimum(snr, torch.tensor(5.0)) / (snr + 1)
        weight = weight + 0.001 * 1000 * process.vlb_weights(model.schedule, given.objective)
        loss = (weight[t].float() * (answer - target).square().mean((1, 2, 3))).mean()
        rate = given.learning_rate
        if given.warmup_steps:
            rate *= min(1, (step + 1) / 4) * 0.5 * (1 + np.cos(np.pi * step / 7))
        optimiser.param_groups[0]["lr"] = rate
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        decay = min(given.ema_decay, (1 + step) / (10 + step))
        average = [decay * a + (1 - decay) * p.detach() for a, p in zip(average, net.parameters(), strict=True)]
    np.testing.assert_allclose(model.history["loss"], losses, rtol=1e-4)
    # Answers, not weights: Adam moves a weight that has no effect (a bias before a normalisation) by rounding errors.
    with torch.no_grad():
        for p, a in zip(net.parameters(), average, strict=True):
            p.copy_(a)
        ours, reference = (one(noise, t, y) for one in (model.net, net))
    assert reference.std() > 0.01
    torch.testing.assert_close(ours, reference, rtol=0, atol=1e-3 * reference.std().item())


def test_noise_prediction_learns_too():
    budget = config(steps=240, objective="epsilon", learning_rate=3e-3, log_every=20)
    simple = train(*data(), budget, progress=False, threads=1).history["simple"]
    assert simple[0] > 0.5 and simple[-1] < 0.5 * simple[0]


@pytest.mark.parametrize("draws", [1, 2])
def test_more_draws_of_t_prefer_noise(monkeypatch, draws):
    """The largest of k uniform t has the distribution ((t + 1) / T)^k; the seed is fixed, so nothing flickers."""
    seen, add_noise = [], process.add_noise

    def spy(schedule, x0, t, noise):
        seen.append(t)
        return add_noise(schedule, x0, t, noise)

    monkeypatch.setattr(process, "add_noise", spy)
    train(*data(250), config(batch_size=250, steps=4, timestep_draws=draws), progress=False, threads=1)
    t = torch.cat(seen).numpy()
    # The Kolmogorov bound at 1 % for n independent numbers is 1.63 / √n (somewhat less for whole numbers).
    share = np.searchsorted(np.sort(t), np.arange(1000), side="right") / len(t)
    assert np.abs(share - (np.arange(1, 1001) / 1000) ** draws).max() < 1.63 / len(t) ** 0.5


def test_every_combination_of_parts_is_trained(monkeypatch):
    """Each part of a joint descriptor is withheld half the time, independently, as a whole, and never otherwise."""
    seen = []
    losses = Run.losses

    def spy(self, rows, y, *rest):
        seen.append(y)
        return losses(self, rows, y, *rest)

    monkeypatch.setattr(Run, "losses", spy)  # which parts were withheld is seen nowhere else
    model = train(*data(400, 4), config(parts=[1, 3], batch_size=100), progress=False)
    unknown = torch.cat(seen).isnan()
    assert bool((unknown[:, 1:].all(1) == unknown[:, 1:].any(1)).all())
    one, other = unknown[:, 0].double(), unknown[:, 1].double()
    sigma = 0.5 / len(unknown) ** 0.5
    for share in (one.mean(), other.mean(), (one == other).double().mean()):
        assert abs(share - 0.5) < 4.5 * sigma  # fails by chance once in 100,000 seeds
    # Sampling takes the same holes, but none inside a part.
    asked = np.array([[5.0, np.nan, np.nan, np.nan], [np.nan, 5.0, 5.0, 5.0]])
    assert generate(model, asked, sampler="ddim", steps=2).shape == (2, 28, 28)
    for hole in ([5.0, 5.0, np.nan, 5.0], [5.0, np.nan, 5.0, 5.0], [np.inf, 5.0, 5.0, 5.0]):
        with pytest.raises(ValueError, match="NaN in a whole part"):
            generate(model, np.array([hole]), sampler="ddim", steps=2)


def test_losses_in_time_are_those_of_a_network_that_answers_zero():
    """A fresh network answers zero, so its error is the target's own size: 1 for ε at any t, and for v it is
    ᾱ + (1 − ᾱ)⟨x₀²⟩. Within five standard errors of a mean over 40 · 784 squares of normal numbers."""
    images, conditions = data(40)
    sigma = (2 / images.size) ** 0.5
    times = [0, 500, 999]
    for objective in ("epsilon", "v"):
        fresh = config(objective=objective)
        model = TrainedModel(fresh.make_net(2).eval(), fresh, conditions.min(0), conditions.max(0))
        bars = model.schedule.alpha_bars[times].numpy()
        size = np.mean((images / 127.5 - 1) ** 2)
        expected = np.ones(3) if objective == "epsilon" else bars + (1 - bars) * size
        for y in (conditions, None):
            np.testing.assert_allclose(losses_in_time(model, images, y, times), expected, atol=5 * sigma)


def test_history_and_progress(capsys):
    model = train(*data(), config(steps=20, log_every=4), progress="box")
    history = model.history
    assert history["step"] == [4, 8, 12, 16, 20]
    simple, vlb, total = (np.array(history[name]) for name in ("simple", "vlb", "loss"))
    np.testing.assert_allclose(total, simple + 0.001 * vlb, rtol=1e-5)  # Eq. 11
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith("box: ") and "images/s" in line for line in lines)  # how many depends on the speed
    assert lines[-1].startswith("box: 20 of 20 steps (100 %), loss ")


def test_epochs_count_batches():
    model = train(*data(20), config(steps=None, epochs=3, batch_size=8, log_every=1), progress=False)
    assert model.history["step"][-1] == 9  # 8 + 8 + 4 structures an epoch


def test_half_precision_is_of_the_networks_arithmetic_alone():
    """What a GPU does by default: bfloat16 has three digits, weights and losses stay in single precision."""
    whole, half = (train(*data(), config(precision=p), progress=False, threads=1) for p in ("float32", "bfloat16"))
    assert half.history["loss"] != whole.history["loss"]
    np.testing.assert_allclose(half.history["loss"], whole.history["loss"], rtol=0.02)
    assert {p.dtype for p in half.net.parameters()} == {torch.float32}


def test_a_compiled_network_is_one_graph_and_learns_the_same(monkeypatch):
    """Whatever a compiler makes of the graph; here it is only traced. Batches of 8, 8 and 4 make two of it."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, fullgraph=True, backend="eager"))
    plain, compiled = (train(*data(), config(compile=c), progress=False, threads=1) for c in (False, True))
    np.testing.assert_allclose(compiled.history["loss"], plain.history["loss"], rtol=1e-5)
    assert list(compiled.net.state_dict()) == list(plain.net.state_dict())


def test_images_may_be_floats():
    images, conditions = data()
    whole = train(images, conditions, config(), progress=False, threads=1)
    floats = train(images / 255.0, conditions, config(), progress=False, threads=1)
    np.testing.assert_allclose(floats.history["loss"], whole.history["loss"], rtol=1e-3)


def test_logs_of_an_interrupted_run_hold_every_step_once(tmp_path, monkeypatch):
    """Interrupted after step 13, with a checkpoint at 8 and rows of the log up to 12, the last one torn."""
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    folder, log = tmp_path / "run", tmp_path / "log"
    with monkeypatch.context() as patch:
        interrupt_at(patch, 13)
        with pytest.raises(Interrupt):
            train(*data(), config(), folder, progress=False, threads=1, log=log)
    with (log / "history.csv").open("a") as file:
        file.write("1")
    history = train(*data(), config(), folder, progress=False, threads=1, log=log).history
    rows = [line.split(",") for line in (log / "history.csv").read_text().splitlines()]
    assert rows[0] == ["step", "loss", "simple", "vlb", "seconds"]
    for column, name in enumerate(("step", "loss", "simple", "vlb")):
        assert [float(row[column]) for row in rows[1:]] == history[name]
    seconds = [float(row[4]) for row in rows[1:]]
    assert seconds == sorted(seconds) and seconds[0] > 0
    board = events.EventAccumulator(str(log)).Reload()
    scalars = board.Scalars("loss")
    assert [event.step for event in scalars] == history["step"]
    np.testing.assert_allclose([event.value for event in scalars], history["loss"], rtol=1e-6)


def test_without_tensorboard_a_line_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    train(*data(), config(steps=3), progress=False, threads=1, log=tmp_path)
    assert "tensorboard is not installed" in capsys.readouterr().out
    assert os.listdir(tmp_path) == ["history.csv"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_a_log_that_does_not_fit_on_its_disk_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    log = _Log(tmp_path, 0)
    log.path = Path("/dev/full")
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        log.add(step=1, loss=0.5, simple=0.5, vlb=0.1, seconds=1.0)


# --- several processes ---------------------------------------------------------------------------------------------

RANKS = """
import json, os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_training import config, data, train
from inflate_lib.diffusion import ranks

ranks.start("cpu")
folder = Path(sys.argv[1])
first = train(*data(17), config(steps=12), folder / "first", progress=False, threads=1)
(folder / f"rank{ranks.rank()}.json").write_text(json.dumps([first.history, first.net.out.weight.norm().item()]))
resumed = train(*data(17), config(), folder / "cut", progress=False, threads=1)
norm = resumed.net.out.weight.norm().item()
(folder / f"resumed{ranks.rank()}.json").write_text(json.dumps([resumed.history, norm]))
ranks.finish()
"""


@pytest.mark.slow
def test_two_processes_train_as_one_does(tmp_path, monkeypatch):
    """Batches of 8, 8 and 1: in the last one, a process has nothing to do. The second run goes on from a checkpoint."""
    with monkeypatch.context() as patch:
        interrupt_at(patch, 10)
        with pytest.raises(Interrupt):
            train(*data(17), config(), tmp_path / "cut", progress=False, threads=1)
    script = tmp_path / "script.py"
    script.write_text(RANKS)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    here = os.path.dirname(__file__)
    done = subprocess.run([*launcher, str(script), str(tmp_path), here], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for name, steps in (("rank", 12), ("resumed", 24)):
        results = [json.loads((tmp_path / f"{name}{rank}.json").read_text()) for rank in range(2)]
        assert results[0] == results[1]
        alone = train(*data(17), config(steps=steps), progress=False, threads=1)
        for key, values in alone.history.items():
            np.testing.assert_allclose(results[0][0][key], values, rtol=1e-5)
        np.testing.assert_allclose(results[0][1], alone.net.out.weight.norm().item(), rtol=1e-4)
    assert os.listdir(tmp_path / "first") == [Loop.checkpoint]


# --- files ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    trained = train(*data(), config(), progress=False, threads=1)
    trained.metadata["descriptor"] = "box"
    return trained


@pytest.mark.parametrize("half", [False, True])
def test_saved_and_loaded(model, tmp_path, half):
    model.save(tmp_path / "m.safetensors", half=half)
    loaded = TrainedModel.load(tmp_path / "m.safetensors")
    assert loaded.config == model.config and loaded.history == model.history
    assert loaded.metadata == model.metadata and loaded.metadata["descriptor"] == "box"
    assert loaded.image_size == (28, 28)
    np.testing.assert_array_equal(loaded.condition_max, model.condition_max)
    targets = [[5.0, 6.0]]
    images = [generate(m, targets, sampler="ddim", steps=3) for m in (model, loaded)]
    np.testing.assert_allclose(*images, atol=2e-2 if half else 0)


def test_half_the_size(model, tmp_path):
    for half in (False, True):
        model.save(tmp_path / f"{half}", half=half)
    assert os.path.getsize(tmp_path / "True") < 0.7 * os.path.getsize(tmp_path / "False")


def damage(path, kind):
    content = bytearray(path.read_bytes())
    if kind == "truncated":
        content = content[: len(content) // 2]
    elif kind == "altered":
        content[-20] ^= 0xFF
    elif kind == "header altered":
        at = content.index(b"condition_max")
        content[at + 18] ^= 0x01
    elif kind == "empty":
        content = b""
    elif kind == "text":
        content = b"not a model at all, but long enough to hold a header"
    path.write_bytes(content)


@pytest.mark.parametrize("kind", ["truncated", "altered", "header altered", "empty", "text"])
def test_a_damaged_file_is_refused_by_name(model, tmp_path, kind):
    path = tmp_path / "model.safetensors"
    model.save(path)
    damage(path, kind)
    with pytest.raises(ValueError, match=r"model\.safetensors"):
        TrainedModel.load(path)


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float64, torch.float16])
def test_weights_of_another_precision_are_read(model, tmp_path, kind):
    """As somebody's ``model.net.bfloat16()`` makes them."""
    other = replace(model, net=copy.deepcopy(model.net).to(kind))
    other.save(tmp_path / "m.safetensors")
    loaded = TrainedModel.load(tmp_path / "m.safetensors").net.state_dict()
    for name, value in other.net.state_dict().items():
        assert torch.equal(loaded[name], value.to(loaded[name].dtype)) and loaded[name].dtype != torch.bfloat16


def resaved(path, change):
    """Write the tensors of a file again, changed, under its own header, as other tools do."""
    from safetensors import safe_open
    from safetensors.torch import save_file

    with safe_open(path, "pt") as file:
        tensors, header = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    save_file(change(tensors), path, header)


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors: {name: value.bfloat16() for name, value in tensors.items()},
        lambda tensors: {name: value.double() for name, value in tensors.items()},
        lambda tensors: dict(list(tensors.items())[1:]),
        lambda tensors: tensors | {"bias": torch.zeros(3)},
        lambda tensors: {},
    ],
    ids=["bfloat16", "float64", "missing", "extra", "none"],
)
def test_a_file_that_was_saved_again_is_refused_by_name(model, tmp_path, change):
    path = tmp_path / "model.safetensors"
    model.save(path)
    resaved(path, change)
    with pytest.raises(ValueError, match=r"model\.safetensors is corrupt, or somebody saved it again"):
        TrainedModel.load(path)


def test_tensors_that_do_not_fit_are_named(model, tmp_path):
    path = tmp_path / "model.safetensors"
    model.save(path)
    tensors, content = storage.read(path, "model")
    first, second = list(tensors)[:2]
    tensors[second] = tensors[second][None]
    storage.write(path, "model", {"more": torch.zeros(())} | {k: v for k, v in tensors.items() if k != first}, content)
    with pytest.raises(ValueError, match=f"{first} missing; more not of it; {second} of another size"):
        TrainedModel.load(path)


def test_a_foreign_safetensors_file_is_refused(tmp_path):
    from safetensors.torch import save_file

    save_file({"weight": torch.ones(3)}, tmp_path / "foreign.safetensors")
    with pytest.raises(ValueError, match=r"foreign\.safetensors is not a model file"):
        TrainedModel.load(tmp_path / "foreign.safetensors")


def test_a_checkpoint_is_not_a_model(tmp_path):
    train(*data(), config(), tmp_path, progress=False, threads=1)
    with pytest.raises(ValueError, match="not a model file"):
        TrainedModel.load(tmp_path / Loop.checkpoint)
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors"):
        TrainedModel.load(tmp_path / "none.safetensors")


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": None}, "exactly one of steps and epochs"),
        ({"epochs": 3}, "exactly one of steps and epochs"),
        ({"objective": "score"}, "'score'"),
        ({"learning_rate_decay": "step"}, "'step'"),
        ({"batch_size": 0}, "batch_size"),
        ({"batch_size": 2.5}, "batch_size"),
        ({"channels": (8, 0)}, r"channels\[1\]"),
        ({"channels": ()}, "channels"),
        ({"embedding": 17}, "embedding"),
        ({"condition_dropout": 1.0}, "condition_dropout"),
        ({"ema_decay": -0.1}, "ema_decay"),
        ({"vlb_weight": float("nan")}, "vlb_weight"),
        ({"learning_rate": -1e-3}, "learning_rate"),
        ({"learning_rate": "1e-4"}, r"1\.0e-3"),
        ({"channels": 64}, "channels"),
        ({"attention": "no"}, "attention"),
        ({"timestep_draws": 0}, "timestep_draws"),
        ({"seed": -1}, "seed"),
    ],
)
def test_an_impossible_configuration_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        config(**options)


def test_configuration_survives_json():
    original = config()
    assert TrainingConfig.from_dict(json.loads(json.dumps(original.as_dict()))) == original
    with pytest.raises(ValueError, match="momentum"):
        TrainingConfig.from_dict({"momentum": 0.9, "steps": 3})


@pytest.mark.parametrize(
    ("images", "conditions", "message"),
    [
        (np.zeros((3, 28, 28)), np.zeros((2, 1)), "one row for each of 3 images"),
        (np.zeros((3, 28, 27)), np.zeros((3, 1)), "divisible by 2"),
        (np.zeros((28, 28)), np.zeros((28, 1)), r"shape \(n, h, w\)"),
        (np.zeros((0, 28, 28)), np.zeros((0, 1)), r"shape \(n, h, w\)"),
        (np.full((3, 28, 28), 200.0), np.zeros((3, 1)), "between 0 and 1"),
        (np.full((3, 28, 28), np.nan), np.zeros((3, 1)), "between 0 and 1"),
        (np.zeros((3, 28, 28)), [[0.0], [np.nan], [1.0]], "finite"),
        (np.zeros((3, 28, 28)), "abc", "conditions must be an array of numbers"),
        (torch.zeros(3, 28, 28, requires_grad=True), np.zeros((3, 1)), "images must be an array of numbers"),
    ],
)
def test_unusable_data_are_named(images, conditions, message):
    with pytest.raises(ValueError, match=message):
        train(images, conditions, config(), progress=False)


@pytest.mark.parametrize("device", ["cuda", "mps", "meta", "gpu", "cuda:99", "", "CPU", None])
def test_a_device_that_is_not_there_is_named(device, monkeypatch):
    for module in ("cuda", "backends.mps"):
        monkeypatch.setattr(f"torch.{module}.is_available", lambda: False)
    with pytest.raises(ValueError, match=f"^device {device!r} cannot be used here, where PyTorch has cpu$"):
        choose_device(device)


def test_device_is_found_or_taken():
    assert choose_device("cpu").type == "cpu"
    found = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    assert choose_device().type == found
