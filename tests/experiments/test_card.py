"""The model card states what was measured, and the files carry it."""

import pytest

from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.diffusion import TrainedModel
from inflate_lib.experiments.card import write_card
from inflate_lib.models.recipe import Recipe
from inflate_lib.models.train import train_models

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
    assert {"R²", "median error / target", "valid"} <= set(model.metadata["metrics"])
    # The weights are those that were measured, and the rest of the header is kept.
    assert all((a == b).all() for a, b in zip(model.net.parameters(), before.net.parameters(), strict=True))
    assert before.metadata.items() <= model.metadata.items()


def test_a_joint_model_is_measured_on_each_descriptor(data, tmp_path):
    model = TrainedModel.load(train_models(["joint"], RECIPE, data)["joint"])
    model.save(tmp_path / "joint.safetensors", half=True)
    text = write_card(tmp_path, data, RECIPE, n=4).read_text(encoding="utf-8")
    asked = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| joint: ")]
    assert asked == [f"joint: {name}" for name in ("height", "width", "box", "area", "axis", "stress", "stretch")]
    metrics = TrainedModel.load(tmp_path / "joint.safetensors").metadata["metrics"]
    assert set(metrics) == {name.removeprefix("joint: ") for name in asked}
    assert "median point distance" in metrics["axis"] and "R²" in metrics["stress"]


def test_weights_that_are_missing_or_of_other_data_are_refused(folder, data, tmp_path):
    with pytest.raises(ValueError, match="holds no weights"):
        write_card(tmp_path / "nothing", data, RECIPE)
    with pytest.raises(ValueError, match=r"axis\.safetensors was trained on other data"):
        write_card(folder, data.isel(structure=slice(0, 50)), RECIPE)
