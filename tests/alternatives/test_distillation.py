"""A student gives its guided teacher's answer, and is asked once a step."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from inflate_lib.alternatives.distillation import distil, tune
from inflate_lib.diffusion import TrainedModel, TrainingConfig, cosine_schedule, generate, process, train
from inflate_lib.diffusion.loop import Loop
from inflate_lib.diffusion.sampling import guided

SMALL = TrainingConfig(
    channels=(8, 16), embedding=16, hidden=16, objective="v", batch_size=16, learning_rate=5e-3, steps=150, T=50
)
TOLD = replace(SMALL, strongest=4.0, distillation_steps=400)
SHORT = replace(TOLD, distillation_steps=24)


def bars(n=64):
    """Images (n, 8, 8) of a bright bar, and how high it is."""
    rng = np.random.default_rng(0)
    height = rng.integers(1, 8, n)
    images = (np.arange(8)[None, :, None] >= 8 - height[:, None, None]) & np.ones((1, 1, 8), bool)
    return images.astype(np.float32), height[:, None].astype(float)


@pytest.fixture(scope="module")
def teacher():
    return train(*bars(), SMALL, progress=False, threads=1)


@pytest.fixture(scope="module")
def student(teacher):
    return distil(teacher, *bars(), TOLD, progress=False)


def states(n=64):
    """Images with a noise that neither has seen, times and scaled descriptors."""
    generator = torch.Generator().manual_seed(1)
    images, heights = bars(n)
    y = torch.from_numpy((heights - heights.min()) / np.ptp(heights)).float()
    x0, t = torch.from_numpy(images)[:, None] * 2 - 1, torch.randint(50, (n,), generator=generator)
    return process.add_noise(cosine_schedule(50), x0, t, torch.randn(x0.shape, generator=generator)), t, y


@pytest.mark.parametrize("w", [1.0, 2.0, 4.0])
def test_a_student_answers_as_its_guided_teacher(teacher, student, w):
    """Much nearer than the answer without guidance is; where w = 1, nearer than the descriptor makes a difference."""
    x, t, y = states()
    with torch.no_grad():
        wanted, plain, without = (guided(teacher.net, x, t, y, strength) for strength in (w, 1, 0))
        miss = (guided(student.net, x, t, y, w) - wanted).square().mean()
    other = plain if w > 1 else without
    assert miss < 0.25 * (other - wanted).square().mean()


def test_before_it_learns_a_student_is_its_teacher_without_guidance(teacher):
    new = distil(teacher, *bars(), replace(TOLD, distillation_steps=1, learning_rate=0.0), progress=False)
    x, t, y = states()
    with torch.no_grad():
        for w in (1.0, 3.0):
            torch.testing.assert_close(guided(new.net, x, t, y, w), teacher.net(x, t, y))


def same(model, other):
    ours, theirs = model.net.state_dict(), other.net.state_dict()
    return ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_student_says_whose_it_is(teacher, student):
    assert student.history == teacher.history and student.metadata["teacher"] == teacher.fingerprint
    assert student.fingerprint != teacher.fingerprint


def test_an_interrupted_distillation_goes_on_where_it_was(teacher, tmp_path, monkeypatch):
    advance = Loop.advance

    def interrupted(run):
        if run.step == 15:
            raise KeyboardInterrupt
        advance(run)

    with monkeypatch.context() as patch:
        patch.setattr(Loop, "advance", interrupted)
        with pytest.raises(KeyboardInterrupt):
            distil(teacher, *bars(), SHORT, tmp_path, progress=False)
    assert (tmp_path / "distillation.safetensors").exists()
    assert same(distil(teacher, *bars(), SHORT, tmp_path, progress=False), distil(teacher, *bars(), SHORT, None, False))


def test_a_student_is_asked_once_a_step_and_a_teacher_twice(teacher, student, tmp_path):
    student.save(tmp_path / "student.safetensors")
    for model, times in ((teacher, 10), (TrainedModel.load(tmp_path / "student.safetensors"), 5)):
        asked = []
        hook = model.net.register_forward_hook(lambda *_, asked=asked: asked.append(1))
        generate(model, [[3.0]], sampler="ddim", steps=5, guidance=3.0, device="cpu")
        hook.remove()
        assert len(asked) == times


def test_what_cannot_be_distilled_or_asked_is_refused(teacher, student):
    with pytest.raises(ValueError, match="guidance must be from 1 to 4"):
        generate(student, [[3.0]], guidance=5.0)
    with pytest.raises(ValueError, match="teacher that is none itself"):
        distil(student, *bars(), TOLD, progress=False)
    with pytest.raises(ValueError, match="strongest > 1"):
        distil(teacher, *bars(), replace(TOLD, strongest=1.0), progress=False)


def height_of(images):
    """How high the bars of images (n, 8, 8) in [0, 1] are, in pixels."""
    return 8 * images.mean(axis=(1, 2))


def miss(x, y):
    """The same for drawings on the network's scale, against scaled conditions; a critic that sees everything."""
    return (8 * (x[:, 0] + 1).mean(dim=(1, 2)) / 2 - (1 + 6 * y[:, 0])).square()


def mean_miss(model, steps=5):
    targets = np.tile([2.0, 3.0, 4.0, 5.0, 6.0], 20)
    images = generate(model, targets, sampler="dpm-solver++", steps=steps, guidance=2.0, device="cpu")
    return np.abs(height_of(images) - targets).mean()


def test_a_tuned_student_comes_nearer_to_its_targets(teacher, student):
    """Also with a number of steps that it was not tuned for."""
    before = student.fingerprint
    tuned = tune(student, teacher, miss, *bars(), steps=100, weight=0.1, progress=False)
    for steps in (5, 6):
        assert mean_miss(tuned, steps) < 0.7 * mean_miss(student, steps)
    assert student.fingerprint == before and tuned.config == student.config
    assert tuned.metadata["teacher"] == teacher.fingerprint and tuned.metadata["tuning"]["steps"] == 100


def test_an_interrupted_tuning_goes_on_where_it_was(teacher, student, tmp_path, monkeypatch):
    advance = Loop.advance

    def interrupted(run):
        if run.step == 9:
            raise KeyboardInterrupt
        advance(run)

    given = student, teacher, miss, *bars(), 14, 0.1
    with monkeypatch.context() as patch:
        patch.setattr(Loop, "advance", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tune(*given, tmp_path, progress=False)
    assert same(tune(*given, tmp_path, progress=False), tune(*given, None, progress=False))
