"""Experiments: what models are trained on, and which weights are used."""

import os
import shutil
import subprocess
import sys
import venv
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
import yaml
from joblib import parallel_config

from inflate_lib import paths
from inflate_lib.datasets.pairs import TrainingSet, held_out
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import DESCRIPTORS, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import PARTS
from inflate_lib.diffusion import TrainedModel, storage
from inflate_lib.diffusion.training import simple_loss
from inflate_lib.experiments.run import held_out_seed, run_experiment
from inflate_lib.models import RETRAIN, remote, train, weights
from inflate_lib.models.recipe import Recipe, load_recipe
from inflate_lib.models.train import train_models, training_cost
from inflate_lib.models.weights import committed_weights, trained_models
from inflate_lib.structures.augmentation import apply_variants, augment
from inflate_lib.structures.sources import load_sevens, resolve_source

TRAINING = {"channels": [4, 8], "embedding": 16, "steps": 4, "batch_size": 8, "learning_rate": 1e-3}
RECIPE = Recipe("digits", 0, None, 100, TRAINING, {"sampler": "ddim", "steps": 2}, 0)


@pytest.fixture(scope="module")
def data():
    """Forty embedded digits with invented descriptors, each of which tells which structure it belongs to."""
    images = load_sevens("digits").images[:40]
    number = np.arange(40.0)
    converged = number != 3
    axes = np.repeat(number, 60).reshape(40, 30, 2)
    return xr.Dataset(
        {
            "image": (("structure", "row", "column"), images),
            "converged": ("structure", converged),
            "height": ("structure", number),
            "width": ("structure", number / 2),
            "hull_area": ("structure", number / 3),
            "medial_axis": (("structure", "point", "axis"), axes),
            "outline": (("structure", "direction"), axes.reshape(40, 60)[:, :32] + np.arange(32)),
            "peak_stress": ("structure", 0.1 + number / 40),
            "peak_stretch": ("structure", 1.1 + number / 40),
        },
        attrs={"source": "digits"},
    )


def test_every_tenth_structure_is_held_out():
    assert np.flatnonzero(held_out(40)).tolist() == [9, 19, 29, 39]
    assert held_out(6265).sum() == 626 and not held_out(9).any()


@pytest.mark.parametrize("n_augmented", [36, 100, 10**6])
def test_no_variant_of_a_held_out_structure_is_trained_on(data, n_augmented):
    images, conditions = TrainingSet(data, "height", n_augmented).pairs
    seen = set(conditions[:, 0].astype(int))
    assert seen == set(range(40)) - {3, 9, 19, 29, 39}  # 3 did not converge
    assert len(images) == len(conditions) <= n_augmented
    hidden = data["image"].values[held_out(40)]
    variants = {image.tobytes() for image in apply_variants(hidden, augment(hidden))}
    assert not variants & {image.tobytes() for image in images}


def test_the_joint_descriptor_holds_the_others_side_by_side(data):
    joint = descriptor_matrix(data, "joint")
    assert joint.shape == (40, 97)
    lengths = {name: get_descriptor(name).length for name in (*DESCRIPTORS, *PARTS)}
    for name in lengths:
        told = get_descriptor("joint").conditions(name, descriptor_matrix(data, name))
        asked = ~np.isnan(told)
        assert asked.sum(1).tolist() == [lengths[name]] * 40
        np.testing.assert_array_equal(told[asked], joint[asked])
    np.testing.assert_array_equal(get_descriptor("joint").conditions("joint", joint), joint)
    conditions = TrainingSet(data, "joint", 100).pairs[1]
    heights, axes = TrainingSet(data, "height", 100).pairs[1], TrainingSet(data, "axis", 100).pairs[1]
    np.testing.assert_array_equal(conditions[:, [0]], heights)
    np.testing.assert_array_equal(conditions[:, 5:65], axes)  # mirrored where the image is
    np.testing.assert_array_equal(conditions[:, 3:5], [0.1, 1.1] + heights / 40)  # peaks are not


def test_the_split_follows_the_position_in_the_whole_data_set(data):
    """A structure that fails must not move the others into or out of the held-out part."""
    failed = data.assign(converged=("structure", np.arange(40) >= 5))
    kept = set(TrainingSet(failed, "height", 100).pairs[1][:, 0].astype(int))
    assert kept == set(range(5, 40)) - {9, 19, 29, 39}


# --- which weights -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """A checkout with trained weights of one descriptor."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "CACHE", home / "cache")
        file = train_models(["box"], RECIPE, data, log=home / "logs")["box"]
    model = TrainedModel.load(file)
    model.metadata |= {"profile": "small"}
    model.save(home / "data" / "pretrained" / "small" / "box.safetensors", half=True)
    return home


@pytest.fixture
def home(trained, tmp_path, monkeypatch):
    """A copy of it with an empty cache, in which every attempt to train is an error."""
    shutil.copytree(trained / "data", tmp_path / "data")
    monkeypatch.setattr(paths, "ROOT", tmp_path)
    monkeypatch.setattr(paths, "PRETRAINED", tmp_path / "data" / "pretrained")
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    monkeypatch.delenv(RETRAIN, raising=False)

    def no_training(names, *_):
        raise RuntimeError(f"would train {names}")

    monkeypatch.setattr(weights, "train_models", no_training)
    return tmp_path


def test_weights_tell_what_they_were_made_from(trained):
    model = TrainedModel.load(trained / "data" / "pretrained" / "small" / "box.safetensors")
    about = model.metadata
    assert about["descriptor"] == "box" and about["source"] == "digits" and about["profile"] == "small"
    assert about["structures"] == 39 and about["pairs"] == about["n_augmented"] == 100
    assert about["held_out"] == "index % 10 == 9" and about["held_out_loss"] > 0 and about["seconds"] > 0
    assert model.config.channels == (4, 8) and len(model.condition_min) == 2
    rows = (trained / "logs" / "box" / "history.csv").read_text().splitlines()
    assert rows[0] == "step,loss,simple,vlb,seconds"
    np.testing.assert_allclose([float(row.split(",")[1]) for row in rows[1:]], model.history["loss"])


def test_committed_weights_are_used_where_they_fit(home, data, capsys):
    recipe = RECIPE.changed(training={"device": "cpu", "checkpoint_every": 3})
    models = trained_models(["box"], recipe, data)
    assert models["box"].trained.metadata["profile"] == "small"
    assert capsys.readouterr().out == "weights from data/pretrained/small: box\n"


def test_other_digits_of_the_simulation_are_no_other_data(home, data):
    jittered = data.assign(height=data["height"] * (1 + 1e-9))
    assert trained_models(["box"], RECIPE, jittered)


@pytest.mark.parametrize("what", ["recipe", "seed", "pairs", "images", "simulation", "retrain"])
def test_and_not_where_they_do_not(home, data, monkeypatch, capsys, what):
    recipe = RECIPE
    if what == "recipe":
        recipe = RECIPE.changed(training={"learning_rate": 2e-3})
    elif what == "seed":
        recipe = RECIPE.changed(seed=1)
    elif what == "pairs":
        recipe = RECIPE.changed(n_augmented=101)
    elif what == "images":
        data = data.assign(image=data["image"][::-1])
    elif what == "simulation":
        data = data.assign(height=data["height"] * 1.001)
    else:
        monkeypatch.setenv(RETRAIN, "1")
    with pytest.raises(RuntimeError, match="would train"):
        trained_models(["box"], recipe, data)
    reasons = {"pairs": "n_augmented", "images": "data", "simulation": "simulation"}
    text = capsys.readouterr().out
    assert "trained for this run: box" in text
    assert (f"box.safetensors is of another {reasons.get(what)}\n" in text) == (what in reasons)


def test_damaged_weights_are_named(home, data):
    path = home / "data" / "pretrained" / "small" / "box.safetensors"
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(ValueError, match=r"small/box\.safetensors is truncated"):
        trained_models(["box"], RECIPE, data)


@pytest.mark.slow
@pytest.mark.mnist
@pytest.mark.parametrize(
    "path", sorted(paths.PRETRAINED.glob("*/*.safetensors")), ids=lambda path: f"{path.parent.name} {path.stem}"
)
def test_committed_weights_are_those_of_their_profile_and_still_mean_what_they_meant(path):
    """A changed profile, data set or network would otherwise go unnoticed until somebody trains for an evening."""
    if resolve_source() != "mnist":
        pytest.skip("MNIST cannot be had: the committed weights are not checked")
    name, profile = path.stem, path.parent.name
    data = simulated_sevens("mnist")
    assert committed_weights(name, load_recipe(profile), data) == (path, "")
    model = TrainedModel.load(path)
    assert model.metadata["descriptor"] == name and model.metadata["profile"] == profile
    loss = simple_loss(model, *TrainingSet(data, name).unseen)
    assert loss == pytest.approx(model.metadata["held_out_loss"], rel=5e-3)  # 16 bits


def test_a_dry_run_projects_the_whole_training(data, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    with parallel_config(backend="threading"):  # processes would take ten seconds to start
        cost = training_cost(["height", "area"], RECIPE.changed(training={"steps": 5000}), data, steps=6)
    assert cost["descriptor"].tolist() == ["height", "area"] and (cost["steps"] == 5000).all()
    np.testing.assert_allclose(cost["hours"], cost["seconds per step"] * 5000 / 3600)
    np.testing.assert_allclose(cost["images per second"], 8 / cost["seconds per step"])
    assert not list(tmp_path.iterdir())  # nothing is kept


@pytest.mark.slow
def test_the_command_trains_in_two_processes_as_in_one(tmp_path):
    """`inflate train` alone and under torchrun: the same losses, and what is written is written once."""
    home = tmp_path / "home"
    (home / "notebooks" / "profiles").mkdir(parents=True)
    recipe = RECIPE.changed(n_structures=20, n_augmented=50, training={"checkpoint_every": 2})
    profile = {"name": "small", "description": "", "recipe": asdict(recipe)}
    (home / "notebooks" / "profiles" / "small.yml").write_text(yaml.safe_dump(profile))
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    found = {}
    for way, launcher in {"alone": ["-m"], "together": [*torchrun, "-m", "--"]}.items():
        out = tmp_path / way
        command = [sys.executable, *launcher, "inflate_lib", "train", "--profile", "small", "--descriptor", "box"]
        command += ["--device", "cpu", "--out", str(out), "--log", str(out / "log")]
        place = {"INFLATE_HOME": str(home), "INFLATE_CACHE": str(tmp_path / f"cache {way}"), "OMP_NUM_THREADS": "1"}
        here = os.environ | place | {"PYTHONPATH": str(paths.ROOT)}
        ended = subprocess.run(command, env=here, capture_output=True, text=True, timeout=600, check=False)
        assert ended.returncode == 0, ended.stderr
        assert sum(line.startswith("box: ") for line in ended.stdout.splitlines()) == 1  # one process tells the result
        assert len((out / "log" / "box" / "history.csv").read_text().splitlines()) == 3  # steps 2 and 4
        found[way] = TrainedModel.load(out / "box.safetensors")
    alone, together = found.values()
    for name, values in alone.history.items():
        np.testing.assert_allclose(together.history[name], values, rtol=1e-5)
    assert together.metadata["held_out_loss"] == pytest.approx(alone.metadata["held_out_loss"], rel=1e-3)


def test_a_descriptor_may_have_a_number_of_steps_of_its_own():
    plain = RECIPE.changed(seed=3, training={"steps": 10})
    recipe = plain.changed(training={"steps_of": {"area": 20}})
    assert recipe.config("area").steps == 20
    assert recipe.config("height") == plain.config("height")
    with pytest.raises(ValueError, match="unknown descriptor 'volume'"):
        plain.changed(training={"steps_of": {"volume": 20}})


# --- training elsewhere --------------------------------------------------------------------------------------------

BROUGHT_BY_PYTORCH = "torchgen functorch filelock fsspec jinja2 markupsafe mpmath networkx sympy typing_extensions.py"


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """``python -m inflate_lib.models.remote`` in an environment with PyTorch, NumPy, safetensors, and no more."""
    home = tmp_path_factory.mktemp("elsewhere")
    venv.create(home, symlinks=True)
    (there,) = home.glob("lib/python*/site-packages")
    patterns = ["torch", "numpy", "numpy.libs", "safetensors", "nvidia", "triton", *BROUGHT_BY_PYTORCH.split()]
    for pattern in patterns:
        for package in Path(torch.__file__).parents[1].glob(pattern):
            (there / package.name).symlink_to(package)
    (there / "inflate_lib").symlink_to(paths.ROOT / "inflate_lib")
    here = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}

    def run(*arguments):
        command = [home / "bin" / "python", *map(str, arguments)]
        return subprocess.run(command, env=here, cwd=home, capture_output=True, text=True, timeout=1200, check=False)

    assert "No module named 'scipy'" in run("-c", "import scipy").stderr
    return lambda *arguments: run("-m", "inflate_lib.models.remote", *arguments)


@pytest.mark.parametrize("name", ["height", "box", "axis"])
def test_a_pack_holds_each_descriptor_and_its_mirror_image(data, tmp_path, name):
    file = tmp_path / "pairs.safetensors"
    train.pack(file, [name], RECIPE, data)
    tensors, _ = storage.read(file, "pack")
    seen = tensors[f"{name}.seen"].numpy()
    assert np.array_equal(get_descriptor(name).mirrored(seen), tensors[f"{name}.mirrored"].numpy())


@pytest.mark.slow
def test_models_trained_elsewhere_are_the_same_to_the_bit(data, tmp_path, monkeypatch, elsewhere):
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(paths, "PRETRAINED", tmp_path / "pretrained")
    recipe = RECIPE.changed(training={"device": "cpu", "checkpoint_every": 2})
    file, out = tmp_path / "pairs.safetensors", tmp_path / "pretrained" / "small"
    train.pack(file, ["box", "axis"], recipe, data, profile="small")
    asked = [file, "--out", out, "--device", "cpu", "--threads", 1]
    ended = elsewhere(*asked)
    assert ended.returncode == 0, ended.stderr
    for name in ("box", "axis"):
        assert committed_weights(name, recipe, data) == (out / f"{name}.safetensors", "")
        theirs = TrainedModel.load(out / f"{name}.safetensors")
        ours = TrainedModel.load(train.trained_model_file(name, recipe, data, threads=1))
        assert theirs.history == ours.history
        for mine, other in zip(ours.net.parameters(), theirs.net.parameters(), strict=True):
            assert torch.equal(mine.half().float(), other)
        known = [{k: v for k, v in m.metadata.items() if not k.startswith("seconds")} for m in (ours, theirs)]
        told = {"profile": "small", "sampling": RECIPE.sampling}
        assert known[1] == known[0] | told and known[0]["held_out_loss"] > 0
    again = elsewhere(*asked)  # from the last checkpoints: nothing is trained twice
    assert again.returncode == 0 and "step" not in again.stdout


@pytest.mark.slow
def test_a_pack_that_cannot_be_used_is_named_in_one_line(data, tmp_path, elsewhere):
    file = tmp_path / "pairs.safetensors"
    train.pack(file, ["box"], RECIPE, data)
    unknown = elsewhere(file, "--only", "height")
    file.write_bytes(file.read_bytes()[:-7])
    for ended, message in (
        (elsewhere("none.safetensors"), "inflate: no pack file at none.safetensors\n"),
        (unknown, f"inflate: {file} has no model 'height'; it has box\n"),
        (elsewhere(file), f"inflate: {file} is truncated"),
    ):
        assert ended.returncode == 1 and ended.stderr.startswith(message) and ended.stderr.count("\n") == 1


@pytest.fixture
def packed(data, tmp_path, monkeypatch):
    """A pack of two models, and the folder in which notebooks would find their weights."""
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(paths, "PRETRAINED", tmp_path / "pretrained")
    recipe = RECIPE.changed(training={"device": "cpu"})
    file = tmp_path / "pairs.safetensors"
    train.pack(file, ["box", "axis"], recipe, data, profile="small")
    return file, tmp_path / "pretrained" / "small", recipe


def test_captured_training_of_a_pack_stops_in_time_goes_on_and_learns_the_same(data, packed, capsys):
    file, out, recipe = packed
    asked = [str(file), "--out", str(out), "--device", "cpu", "--graph"]
    remote.main([*asked, "--minutes", "0"])
    stopped = TrainedModel.load(out / "box.safetensors")
    assert stopped.history["step"] == [1] and stopped.metadata["epochs_done"] == round(1 / 13, 2)  # 100 pairs by eights
    remote.main(asked)
    for name in ("box", "axis"):
        assert committed_weights(name, recipe, data) == (out / f"{name}.safetensors", "")
        theirs = TrainedModel.load(out / f"{name}.safetensors")
        ours = TrainedModel.load(train.trained_model_file(name, recipe, data))
        for mine, other in zip(ours.net.parameters(), theirs.net.parameters(), strict=True):
            assert torch.equal(mine.half().float(), other)
        assert theirs.metadata["epochs_done"] == round(4 / 13, 2) and theirs.metadata["profile"] == "small"
        assert theirs.metadata["held_out_loss"] == ours.metadata["held_out_loss"]


def test_what_was_drawn_elsewhere_is_taken_where_all_is_the_same(data, packed, tmp_path, monkeypatch, capsys):
    file, out, recipe = packed
    asked = [str(file), "--out", str(out), "--device", "cpu", "--only", "box"]
    remote.main([*asked, "--graph"])
    box = np.array([[10.0, 5.0], [20.0, 10.0]])
    np.savez(tmp_path / "targets.npz", **{"box": np.repeat(box, 2, axis=0) * (1 + 1e-9), "box.held_out": box})
    remote.main([*asked, "--draw", str(tmp_path / "targets.npz")])
    tensors, record = storage.read(out / "drawings" / "targets.safetensors", "drawing")
    assert tensors["box.images"].dtype == torch.uint8 and record["box"]["sampling"] == RECIPE.sampling
    model = trained_models(["box"], recipe, data)["box"]
    capsys.readouterr()

    found = run_experiment(model, box, 2)
    drawn = {"box": run_experiment(model, box, 2), "box.held_out": run_experiment(model, box, 1, held_out_seed(0))}
    for key, found in drawn.items():
        assert np.array_equal(np.round(255 * found["image"].values), tensors[f"{key}.images"].numpy())
    assert capsys.readouterr().out.count("structures from targets.safetensors: box\n") == 3
    monkeypatch.setattr(paths, "PRETRAINED", tmp_path / "none")
    anew = run_experiment(model, box, 2)["image"].values
    assert 0 < np.abs(anew - drawn["box"]["image"].values).max() <= 0.5 / 255  # the same structures in 8 bits

    monkeypatch.setattr(paths, "PRETRAINED", out.parent)
    capsys.readouterr()
    with torch.no_grad():
        other = weights.replace(model, trained=TrainedModel.load(out / "box.safetensors"))
        other.trained.net.out.bias += 1e-6
    run_experiment(other, box, 2)
    run_experiment(model.sampled(steps=3), box, 2)
    run_experiment(model, box, 2, seed=1)
    run_experiment(model, box * 1.001, 2)
    run_experiment(model, box, 3)
    assert "structures from" not in capsys.readouterr().out


def test_what_captured_training_and_drawing_cannot_use_is_named(packed, tmp_path):
    file, out, _ = packed
    asked = [str(file), "--out", str(out), "--device", "cpu"]
    (tmp_path / "text.npz").write_text("height")
    np.savez(tmp_path / "targets.npz", height=np.ones(3))
    tensors, content = storage.read(file, "pack")
    old = tmp_path / "old.safetensors"
    storage.write(old, "pack", {name: t for name, t in tensors.items() if "mirrored" not in name}, content)
    for arguments, message in (
        ([*asked, "--draw", str(tmp_path / "text.npz")], r"text\.npz is no npz file of targets"),
        ([*asked, "--draw", str(tmp_path / "targets.npz")], r"targets\.npz has no targets for box, axis"),
        ([*asked, "--graph", "--start", str(tmp_path)], "no model file at .*box.safetensors"),
        ([str(old), *asked[1:], "--graph"], r"old\.safetensors was written by an older version"),
    ):
        with pytest.raises(SystemExit, match=message):
            remote.main(arguments)
    with pytest.raises(SystemExit):
        remote.main([*asked, "--minutes", "3"])
