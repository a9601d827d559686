"""The model card states what was measured, and the files carry it."""

import warnings

import numpy as np
import pytest

from inflate_lib import load_model, paths
from inflate_lib.alternatives.students import student_file
from inflate_lib.book.card import write_card
from inflate_lib.datasets.pairs import held_out
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.diffusion import TrainedModel
from inflate_lib.experiments import calibrate
from inflate_lib.experiments.calibrate import calibrate_weights
from inflate_lib.experiments.run import inside, run_experiment, run_held_out
from inflate_lib.experiments.tables import scores, with_interval
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.recipe import Recipe
from inflate_lib.models.train import train_models
from inflate_lib.models.weights import Model, trained_models

TRAINING = {"channels": [4, 8], "embedding": 16, "objective": "v", "steps": 4, "batch_size": 8, "device": "cpu"}
SAMPLING = {"sampler": "ddim", "steps": 2, "eta": 1.0, "guidance": 1.0}
RECIPE = Recipe("digits", 0, 60, 60, TRAINING, SAMPLING, 0)


@pytest.fixture(scope="module")
def data():
    return simulated_sevens("digits", 60)


@pytest.fixture
def folder(data, tmp_path):
    for name, path in train_models(["height", "axis"], RECIPE, data).items():
        model = TrainedModel.load(path)
        model.metadata |= {"profile": "tiny"}
        model.save(tmp_path / "tiny" / f"{name}.safetensors", half=True)
    return tmp_path / "tiny"


def test_card_tells_data_recipe_cost_and_accuracy(folder, data):
    before = TrainedModel.load(folder / "height.safetensors")
    text = write_card(folder, data, RECIPE, n=4).read_text(encoding="utf-8")
    model = TrainedModel.load(folder / "height.safetensors")
    assert "profile `tiny`" in text and before.metadata["data"] in text
    assert "the model was told the target itself" in text
    assert f"{model.net.n_parameters:,}" in text and f"{model.history['loss'][-1]:.4f}" in text
    rows = [line for line in text.splitlines() if line.startswith(("| height", "| axis"))]
    assert len(rows) == 4  # training and accuracy of each
    assert {"R²", "median error / target", "valid", "buildable"} <= set(model.metadata["metrics"])
    words = " ".join(text.split())
    assert "valid (%) | buildable (%)" in words
    assert f"of the real structures of the data {100 * float(data.buildable.mean()):.1f} % are" in words
    # The weights are those that were measured, and the rest of the header is kept.
    assert all((a == b).all() for a, b in zip(model.net.parameters(), before.net.parameters(), strict=True))
    assert before.metadata.items() <= model.metadata.items()


def test_the_card_states_what_the_chapters_compute(folder, data):
    """One protocol: the card's numbers are those of `run_held_out` with the recipe's seed, to the last digit."""
    text = write_card(folder, data, RECIPE).read_text(encoding="utf-8")
    model = Model("height", TrainedModel.load(folder / "height.safetensors"), SAMPLING)
    drawn = run_held_out(model, data, RECIPE.seed)
    unseen = np.flatnonzero(data["converged"].values & held_out(data.sizes["structure"]))
    known = descriptor_matrix(data, "height")[unseen]
    known = known[inside(model.trained, "height", known)]
    np.testing.assert_array_equal(np.sort(drawn["target"].values, axis=0), np.sort(known, axis=0))  # each of them, once
    table = scores(drawn, "height", data, seed=RECIPE.seed).set_index("measure")
    row = next(line for line in text.split("## Accuracy")[1].splitlines() if line.startswith("| height"))
    assert f"| {with_interval(*table.loc['within 5 %', ['value', 'low', 'high']])} " in row
    # Other noise than that of an experiment with the same seed.
    plain = run_experiment(model, drawn["target"].values, 1, RECIPE.seed)
    assert all((one != other).any() for one, other in zip(plain["image"].values, drawn["image"].values, strict=True))


def test_stored_calibrations_are_used_and_nothing_is_drawn_again(folder, data, monkeypatch):
    """What lies with the weights for this sampling, n and seed is taken; for another n or sampling it is not."""
    fit = Calibration(np.array([0.9]), np.eye(1), np.array([0.02]), np.array([[1.25]]))
    monkeypatch.setattr(calibrate, "calibrate", lambda *_: fit)
    recipe = RECIPE.changed(n_calibration=4)
    calibrate_weights(folder, data, recipe, ["height"])
    assert "calibration" not in TrainedModel.load(folder / "axis.safetensors").metadata
    monkeypatch.setattr(calibrate, "calibrate", lambda *_, **__: pytest.fail("it drew"))
    monkeypatch.setattr(paths, "PRETRAINED", folder.parent)
    found = calibrate.calibrate_all(trained_models(["height"], recipe, data), data, 4, recipe.seed)
    assert found["height"].calibrations["height"].as_dict() == fit.as_dict()
    for other in (recipe.changed(n_calibration=5), recipe.changed(sampling={"guidance": 2.0})):
        assert not trained_models(["height"], other, data)["height"].calibrations


def test_each_purpose_has_its_sampling_and_a_calibration_for_it(folder, data, monkeypatch):
    """A model comes as the paper's experiments ask it; for another purpose it is told otherwise, and told apart."""

    def fit(model, *_, **__):
        return Calibration(np.array([0.9]), np.eye(1), np.array([0.0]), np.array([[1.0 + model.sampling["steps"]]]))

    monkeypatch.setattr(calibrate, "calibrate", fit)
    monkeypatch.setattr(paths, "PRETRAINED", folder.parent)
    recipe = RECIPE.changed(n_calibration=4, samplers={"quick": {"steps": 1}})
    calibrate_weights(folder, data, recipe, ["height"])
    for model in (load_model("height", "tiny"), trained_models(["height"], recipe, data)["height"]):
        quick = model.made_for("quick")
        assert dict(model.sampling) == SAMPLING and dict(quick.sampling) == {**SAMPLING, "steps": 1}
        assert model.calibrations["height"].slope == 3 and quick.calibrations["height"].slope == 2
        assert model.made_for("faithful") is model and model.made_for("varied") is model
        with pytest.raises(ValueError, match="purpose must be one of faithful, varied, quick, steered, not 'fast'"):
            model.made_for("fast")
    other = trained_models(["height"], recipe.changed(samplers={"quick": {"steps": 3}}), data)["height"]
    assert other.calibrations and not other.made_for("quick").calibrations


def test_a_student_answers_for_its_own_teacher_where_it_is_quick(folder, data, monkeypatch):
    monkeypatch.setattr(calibrate, "calibrate", lambda *_: Calibration(np.zeros(1), np.eye(1), np.zeros(1), np.eye(1)))
    monkeypatch.setattr(paths, "PRETRAINED", folder.parent)
    (folder / "axis.safetensors").unlink()
    recipe = RECIPE.changed(
        samplers={"quick": {"steps": 1, "guidance": 3.0}}, student={"strongest": 4.0, "distillation_steps": 2}
    )
    teacher = TrainedModel.load(folder / "height.safetensors")
    student = TrainedModel.load(student_file(folder / "height.safetensors", recipe, data))
    student.save(folder / "students" / "height.safetensors", half=True)
    text = write_card(folder, data, recipe, n=4).read_text(encoding="utf-8")
    assert "| height, quick" in text and "*quick*: steps 1, guidance 3.0" in text
    for model in (load_model("height", "tiny"), trained_models(["height"], recipe, data)["height"]):
        quick = model.made_for("quick")
        assert quick.trained.config.strongest == 4 and not model.trained.config.strongest
        assert quick.sampling == {**SAMPLING, "steps": 1, "guidance": 3.0}
        assert quick.draw({"height": float(data["height"].median())}, 2).shape == (2, 28, 28)
    teacher.net.null.data += 1  # another teacher has no student
    teacher.save(folder / "height.safetensors", half=True)
    with pytest.warns(UserWarning, match="not calibrated"):
        assert not load_model("height", "tiny").made_for("quick").trained.config.strongest


def test_weights_without_a_calibration_say_what_to_do(folder, data, monkeypatch):
    monkeypatch.setattr(paths, "PRETRAINED", folder.parent)
    with pytest.warns(UserWarning, match="not calibrated: `inflate card --profile tiny`"):
        assert not load_model("height", "tiny").calibrations
    calibrate_weights(folder, data, RECIPE)  # a recipe that wants none
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_model("height", "tiny")


def test_a_joint_model_is_measured_on_each_descriptor(data, tmp_path):
    model = TrainedModel.load(train_models(["joint"], RECIPE, data)["joint"])
    model.save(tmp_path / "joint.safetensors", half=True)
    text = write_card(tmp_path, data, RECIPE, n=4).read_text(encoding="utf-8")
    asked = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| joint: ")]
    measured = ("height", "width", "box", "area", "axis", "stress", "stretch", "outline")
    assert asked == [f"joint: {name}" for name in measured]
    metrics = TrainedModel.load(tmp_path / "joint.safetensors").metadata["metrics"]
    assert set(metrics) == {name.removeprefix("joint: ") for name in asked}
    assert "median point distance" in metrics["axis"] and "R²" in metrics["stress"]


def test_what_was_drawn_for_the_card_is_not_drawn_again(folder, data, monkeypatch, capsys):
    """The stored drawings are those of these weights, targets and noise, and of no others."""
    monkeypatch.setattr(paths, "PRETRAINED", folder.parent)
    write_card(folder, data, RECIPE)
    assert sorted(path.name for path in (folder / "drawings").iterdir()) == ["held_out.safetensors"]
    capsys.readouterr()
    model = Model("height", TrainedModel.load(folder / "height.safetensors"), SAMPLING)
    with monkeypatch.context() as patch:
        patch.setattr("inflate_lib.experiments.run.generate", None)  # nothing is drawn
        stored = run_held_out(model, data)
    assert "structures from held_out.safetensors: height" in capsys.readouterr().out
    drawn = run_held_out(model.sampled(steps=2, eta=1.0), data, seed=1)
    assert stored["image"].shape == drawn["image"].shape and not np.array_equal(stored["image"], drawn["image"])
    assert "held_out" not in capsys.readouterr().out
    again = write_card(folder, data, RECIPE)
    assert again.is_file()  # it replaces what it wrote


def test_weights_that_are_missing_or_of_other_data_are_refused(folder, data, tmp_path):
    with pytest.raises(ValueError, match="holds no weights"):
        write_card(tmp_path / "nothing", data, RECIPE)
    with pytest.raises(ValueError, match=r"axis\.safetensors was trained on other data"):
        write_card(folder, data.isel(structure=slice(0, 50)), RECIPE)


def test_a_model_comes_back_with_what_was_measured_of_it(folder, data, monkeypatch):
    """The calibrations in the header are those of the fit, and the weights are untouched."""
    before = (folder / "height.safetensors").read_bytes()
    fit = Calibration(np.array([0.9]), np.eye(1), np.array([0.02]), np.array([[1.25]]))
    monkeypatch.setattr(calibrate, "calibrate", lambda *_: fit)  # a network that learned for four steps does not listen
    (folder / "axis.safetensors").unlink()
    calibrate_weights(folder, data, RECIPE.changed(n_calibration=4))
    assert (folder / "height.safetensors").read_bytes() != before
    monkeypatch.setattr(paths, "PRETRAINED", folder.parent)
    model = load_model("height", "tiny")
    assert model.sampling == SAMPLING and model.reach.sizes["structure"] == int(data["converged"].sum())
    assert model.calibrations["height"].as_dict() == fit.as_dict()
    height = float(data["height"].median())
    told = float(fit.told([[height]])[0, 0])
    bare = Model("height", model.trained, SAMPLING)
    np.testing.assert_array_equal(model.draw({"height": height}, 2), bare.draw({"height": told}, 2))
