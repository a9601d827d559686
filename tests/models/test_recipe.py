"""The recipe of a profile: found by name, changed in parts, and strictly checked."""

import pytest
import yaml

from inflate_lib.models.recipe import Recipe, load_recipe

PLAIN = {
    "source": "digits",
    "seed": 0,
    "n_structures": None,
    "n_augmented": 50,
    "training": {"steps": 4, "channels": [4, 8]},
    "sampling": {"sampler": "ddim", "steps": 2},
    "n_calibration": 0,
}


def test_a_notebook_opened_by_hand_has_the_recipe_of_a_profile():
    assert load_recipe("interactive") == load_recipe() == load_recipe("laptop")
    assert load_recipe("paper").source == "mnist"


def test_a_change_replaces_what_it_names_and_nothing_else():
    recipe = Recipe.from_dict(PLAIN)
    changed = recipe.changed(training={"steps": 9}, sampling=None, seed=3)
    assert changed.training == {"steps": 9, "channels": [4, 8]} and changed.seed == 3
    assert changed.sampling == recipe.sampling and recipe.changed() == recipe
    assert changed.config("height").steps == 9 and changed.config("height").seed == 3
    # Papermill hands over what stands behind -p as text.
    assert recipe.changed(training='{"steps": 9}') == recipe.changed(training={"steps": 9})


def test_another_purpose_changes_what_it_names():
    recipe = Recipe.from_dict(PLAIN | {"samplers": {"quick": {"steps": 1}}})
    assert recipe.ways() == {"quick": {"sampler": "ddim", "steps": 1}} and Recipe.from_dict(PLAIN).ways() == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trainings": {}}, "recipe: unknown trainings; there are: source, seed, n_structures"),
        ({"training": {"stps": 9}}, "unknown training options: stps; there are: channels, embedding"),
        ({"training": {"learning_rate": "1e-3"}}, r"learning_rate must be a number.*write 1\.0e-3"),
        ({"training": {"seed": 1}}, "training: seed follows from the recipe"),
        ({"training": {"steps_of": {"volume": 9}}}, "unknown descriptor 'volume'"),
        ({"training": {"steps_of": 5}}, "steps_of must be a mapping of descriptors to numbers of steps, not 5"),
        ({"training": {"steps_of": {"area": "x"}}}, "steps_of.area must be a whole number of at least 1, not 'x'"),
        ({"sampling": {"eta": 1.5}}, "sampling.eta must be between 0 and 1, not 1.5"),
        ({"training": "fast"}, "training must be a mapping of options"),
        ({"sampling": {"guidence": 1.0}}, "sampling: unknown guidence; there are: sampler, steps, eta, guidance"),
        ({"sampling": {"guidance": "1e-3"}}, r"sampling\.guidance must be a finite number.*write 1\.0e-3"),
        ({"sampling": {"sampler": "fast"}}, r"sampling\.sampler must be one of ancestral, ddim"),
        ({"samplers": {"quick": 5}}, "samplers.quick must be a mapping of options, not 5"),
        ({"samplers": {"quick": {"stps": 5}}}, "quick: unknown stps; there are: sampler, steps"),
        ({"tuning": {"steps": 5}}, "tuning: there is no student to tune"),
        ({"tuning": {"stps": 5}}, "tuning: unknown stps; there are: steps, weight, blends, surrogate_steps, drawings"),
        ({"tuning": {"steps_of": {"lenght": 5}}, "student": {"strongest": 5.0}}, "lenght"),
        ({"tuning": {"blends": 0}}, r"tuning\.blends must be a whole number of at least 1"),
        (
            {"tuning": {"drawings": 9}, "student": {"strongest": 5.0}, "samplers": {"steered": {"steps": 5}}},
            r"tuning\.drawings needs a way to steer them",
        ),
        ({"tuning": {"weight": 0}}, r"tuning\.weight must be a positive"),
        ({"samplers": {"slow": {}}}, "samplers: unknown slow; there are: varied, quick"),
        ({"sampling": {"steps": 0}}, r"sampling\.steps must be a whole number of at least 1"),
        ({"source": "letters"}, "source must be one of auto, mnist, digits"),
        ({"seed": 1.5}, "seed must be a whole number"),
        ({"n_structures": 0}, "n_structures must be a whole number"),
    ],
)
def test_what_is_not_in_a_recipe_is_refused_with_what_is(change, message):
    with pytest.raises(ValueError, match=message):
        Recipe.from_dict(PLAIN).changed(**change)


def test_a_file_that_holds_no_recipe_is_named(tmp_path):
    for content, message in (
        ({"name": "own"}, r"own\.yml: a recipe must be a mapping"),
        ({"recipe": {"seed": 0}}, r"own\.yml: recipe: source, n_structures, .* missing"),
        ({"recipe": PLAIN | {"colour": "red"}}, r"own\.yml: recipe: unknown colour"),
    ):
        (tmp_path / "own.yml").write_text(yaml.safe_dump(content))
        with pytest.raises(ValueError, match=message):
            load_recipe("own", tmp_path)
    with pytest.raises(ValueError, match=r"no profile 'other' in .*; there are: own"):
        load_recipe("other", tmp_path)
