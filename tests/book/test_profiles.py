"""Profiles: every mistake in one is found before anything runs, and named."""

import json
import math

import pytest
import yaml

from inflate_lib import paths
from inflate_lib.book.build import SECONDS
from inflate_lib.book.profiles import BUDGET, ProfileError, check_profile, declared_parameters, load_profile
from inflate_lib.book.run import find_notebooks
from inflate_lib.descriptors import DESCRIPTORS, get_descriptor
from inflate_lib.diffusion import TrainingConfig
from inflate_lib.models.recipe import EDITION, load_recipe

CELL = "# T\n\n```{{code-cell}} ipython3\n:tags: [parameters]\n\n{}\n```\n"
RECIPE = {"source": "digits", "seed": 0, "n_structures": None, "n_augmented": 50, "n_calibration": 0}
RECIPE |= {"training": {"steps": 4}, "sampling": {"sampler": "ddim", "steps": 2}}
DEFAULTS = """\
profile = "interactive"  # set by the runner
seed = 0  # random numbers
rate = 1.0e-3  # learning rate
channels = [16, 32]  # widths
fast = True  # sampler
limit = None  # all
options = {"rate": 1.0e-3, "name": "ddim"}  # of the training"""


@pytest.fixture
def notebooks(tmp_path):
    first, second = tmp_path / "01_first.md", tmp_path / "02_second.md"
    first.write_text(CELL.format(DEFAULTS))
    second.write_text(CELL.format('profile = "interactive"\nseed = 0'))
    return [first, second]


def profile(folder, text, name="test"):
    (folder / f"{name}.yml").write_text(f"name: {name}\nrecipe: {json.dumps(RECIPE)}\n{text}")
    return load_profile(name, folder)


def test_parameters_are_defaults_then_common_then_section(notebooks, tmp_path):
    section = "{channels: [8], limit: 3, options: {rate: 1}}"
    test = profile(tmp_path, f"common: {{seed: 7, rate: 1}}\nnotebooks: {{01_first: {section}}}")
    check_profile(test, notebooks)
    first = test.parameters(notebooks[0])
    assert first.pop("options") == {"rate": 1.0, "name": "ddim"}
    assert first == {"profile": "test", "seed": 7, "rate": 1.0, "channels": [8], "fast": True, "limit": 3}
    assert isinstance(first["rate"], float)
    assert test.parameters(notebooks[1]) == {"profile": "test", "seed": 7}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("common: {sed: 1}", r"common\.sed: no notebook declares"),
        ("common: {seed: zero}", r"common\.seed: 'zero' is str"),
        ("notebooks: {03_third: {}}", r"03_third: there is no such notebook; there are: 01_first, 02_second"),
        ("notebooks: {02_second: {rate: 0.1}}", r"02_second\.rate: the notebook does not declare it; it has"),
        ("notebooks: {01_first: {rate: 1e-3}}", r"YAML reads 1e-3 as text: write 1\.0e-3"),
        ("notebooks: {01_first: {rate: fast}}", r"rate: 'fast' is str, the notebook's default 0\.001 is float"),
        ("notebooks: {01_first: {seed: 1.5}}", r"seed: 1\.5 is float"),
        ("notebooks: {01_first: {seed: true}}", r"seed: True is bool"),
        ("notebooks: {01_first: {fast: 1}}", r"fast: 1 is int"),
        ("notebooks: {01_first: {channels: [a]}}", r"channels: \['a'\]"),
        ("notebooks: {01_first: {channels: 16}}", r"channels: 16 is int"),
        ("notebooks: {01_first: {options: {rate: 1e-4}}}", r"options\.rate: '1e-4' is str.*write 1\.0e-4"),
        ("notebooks: {01_first: {options: {other: 2}}}", r"options: unknown other; there are: rate, name"),
        ("notebooks: {01_first: {options: {name: 3}}}", r"options\.name: 3 is int"),
        ("notebooks: {01_first: {options: 3}}", r"options: 3 is int"),
        ("notebooks: {01_first: {profile: x}}", r"the runner sets this one itself"),
        ("common: {profile: x}", r"common\.profile: the runner sets this one itself"),
        ("first: 03_third", r"first: there is no notebook 03_third"),
        ("budget: {03_third: 60}", r"budget\.03_third: there is no such notebook"),
    ],
)
def test_a_value_that_does_not_fit_is_named(notebooks, tmp_path, text, message):
    with pytest.raises(ProfileError, match=message):
        check_profile(profile(tmp_path, text), notebooks)


def test_all_problems_are_listed_at_once(notebooks, tmp_path):
    with pytest.raises(ProfileError, match=r"(?s)sed.*wrong"):
        check_profile(profile(tmp_path, "common: {sed: 1}\nnotebooks: {02_second: {wrong: 1}}"), notebooks)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colour: red", "colour: Extra inputs"),
        ("common: [1, 2]", "common: .*dictionary"),
        ("budget: {01_first: long}", "budget.01_first: .*number"),
        ("notebooks: {01_first: 3}", "01_first: .*dictionary"),
        ("common: {seed: 1, seed: 2}", "'seed' is given twice"),
        ("common: {", "not valid YAML"),
    ],
)
def test_a_file_without_the_layout_is_refused(tmp_path, text, message):
    with pytest.raises(ProfileError, match=message):
        profile(tmp_path, text)


def test_a_file_that_is_no_text_is_named(tmp_path):
    (tmp_path / "ci.yml").write_bytes(b"name: ci\n\xff\xfe")
    with pytest.raises(ProfileError, match=r"ci\.yml is not valid YAML"):
        load_profile("ci", tmp_path)


def test_name_and_file_must_agree_and_exist(tmp_path):
    (tmp_path / "ci.yml").write_text(f"name: laptop\nrecipe: {json.dumps(RECIPE)}")
    with pytest.raises(ProfileError, match="calls itself 'laptop'"):
        load_profile("ci", tmp_path)
    with pytest.raises(ProfileError, match=r"no profile 'fast'.*there are: ci"):
        load_profile("fast", tmp_path)


@pytest.mark.parametrize(
    ("cell", "message"),
    [("x = [i for i in 'ab']", "plain value"), ("import os", "plain value"), ("x = (1, 2)", "write a list")],
)
def test_a_parameters_cell_holds_plain_values(tmp_path, cell, message):
    path = tmp_path / "01_first.md"
    path.write_text(CELL.format(cell))
    with pytest.raises(ProfileError, match=message):
        declared_parameters(path)


def test_two_parameters_cells_are_refused_and_none_is_none(tmp_path):
    path = tmp_path / "01_first.md"
    path.write_text("# T\n\ntext\n")
    assert declared_parameters(path) == {}
    path.write_text(CELL.format("x = 1") + "\n" + CELL.format("x = 2"))
    with pytest.raises(ProfileError, match="2 cells"):
        declared_parameters(path)


@pytest.mark.parametrize("name", ["ci", "laptop", "paper"])
def test_the_profiles_of_this_repository_fit_its_notebooks(name):
    check_profile(load_profile(name), find_notebooks())


@pytest.mark.parametrize("path", sorted(paths.NOTEBOOKS.glob("[0-9][0-9]_*.md")), ids=lambda path: path.stem)
def test_notebook_defaults_are_the_edition(path):
    declared = declared_parameters(path)
    assert declared.pop("profile") == "interactive"
    assert declared.pop("source") is None and declared.pop("seed", None) is None  # as the recipe says
    used = load_profile(EDITION).parameters(path)
    assert used.pop("profile") == EDITION
    assert used == declared | {name: None for name in ("source", "seed") if name in used}


@pytest.mark.parametrize(("name", "minutes"), [("laptop", 8), ("ci", 5)])
def test_budgets_keep_what_the_two_commands_promise(name, minutes):
    """Two notebooks side by side, then the pages; the edition's minutes include the installation."""
    budgets = load_profile(name).budgets(find_notebooks())
    installation = 150 if name == "laptop" else 0
    assert max(budgets.values()) <= BUDGET
    assert sum(budgets.values()) / 2 + SECONDS + installation <= 60 * minutes


def test_the_paper_profile_is_what_the_paper_prints():
    entries = yaml.safe_load((paths.REFERENCE / "paper.yml").read_text(encoding="utf-8"))
    printed = {name: entry["value"] for name, entry in entries.items()}
    recipe = load_recipe("paper")
    n, sampling = recipe.n_augmented, recipe.sampling
    assert n == printed["augmented_samples"] and printed["descriptor_dimension"] == {
        name: get_descriptor(name).length for name in DESCRIPTORS
    }
    assert (sampling["sampler"], sampling["guidance"], recipe.n_calibration) == ("ancestral", printed["guidance"], 0)
    per_epoch = math.ceil(n / printed["batch_size"])
    for config in (recipe.config("height"), TrainingConfig(epochs=150)):  # and the defaults
        assert config.T == sampling["steps"] == printed["diffusion_steps"]
        assert [1, *config.channels] == printed["channels"] and config.embedding == printed["embedding_dimension"]
        net = config.make_net(1)
        widths = [layer.out_features for layer in net.descriptor if hasattr(layer, "out_features")]
        assert widths == [*printed["descriptor_hidden_units"], printed["embedding_dimension"]]
        assert (config.vlb_weight, config.condition_dropout) == (printed["vlb_weight"], printed["condition_dropout"])
        assert (config.batch_size, config.learning_rate) == (printed["batch_size"], printed["learning_rate"])
        assert config.training_steps(n) == printed["epochs"] * per_epoch
        assert config.checkpoint_steps(n) == printed["checkpoint_epochs"] * per_epoch
        # and none of the options that the paper does not have
        assert (config.objective, config.timestep_draws, config.min_snr, config.ema_decay) == ("epsilon", 1, 0, 0)
        assert (config.learning_rate_decay, config.warmup_steps) == ("constant", 0)
