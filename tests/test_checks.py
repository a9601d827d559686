"""Checks of arguments: what is let through, what is refused, and that the message names both sides."""

import importlib
import inspect
import math
import types
import typing

import numpy as np
import pytest

from inflate_lib import build_mesh, inflate, label_image
from inflate_lib._checks import choice, flag, number, numbers, positive_number, whole_number, workers
from inflate_lib.inverse.constraints import Constraints, from_millimetres


def test_what_is_right_passes():
    assert whole_number("n", np.int64(3), 1, 3) == 3 and type(whole_number("n", np.int64(3), 1)) is int
    assert number("x", 0, least=0, below=1) == 0 and number("x", np.float32(-2.5)) == -2.5
    assert positive_number("x", math.inf, finite=False) == math.inf
    assert choice("sampler", "ddim", ("ddim", "ancestral")) == "ddim" and flag("symmetric", False) is False


@pytest.mark.parametrize("value", [True, 1.0, "1", None, 0, 4])
def test_no_whole_number(value):
    with pytest.raises(ValueError, match=f"n must be a whole number from 1 to 3, not {value!r}"):
        whole_number("n", value, 1, 3)


@pytest.mark.parametrize("value", [True, "x", None, math.nan, 1, -0.1, 1j, np.zeros(1)])
def test_no_number_in_a_range(value):
    with pytest.raises(ValueError, match=r"x must be a number of at least 0 and less than 1, not "):
        number("x", value, least=0, below=1)


@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf, False, "1.0"])
def test_no_positive_number(value):
    with pytest.raises(ValueError, match=f"size must be a positive number of millimetres, not {value!r}"):
        positive_number("size", value, "millimetres")


def test_a_number_that_came_as_text_comes_with_a_hint():
    with pytest.raises(ValueError, match=r"rate must be a number of at least 0, not '1e-3' \(YAML reads 1e-3 as text"):
        number("rate", "1e-3", least=0)
    with pytest.raises(ValueError, match=r"not '0\.001'$"):
        number("rate", "0.001", least=0)
    with pytest.raises(ValueError, match=r"not 'fast'$"):
        number("rate", "fast", least=0)


def test_no_choice_and_no_flag():
    for value in ("DDIM", None, ["ddim"]):
        with pytest.raises(ValueError, match=r"sampler must be one of ddim, ancestral, not "):
            choice("sampler", value, ("ddim", "ancestral"))
    with pytest.raises(ValueError, match="symmetric must be true or false, not 1"):
        flag("symmetric", 1)


@pytest.mark.parametrize(
    "values",
    [True, "12", ["1", "2"], [1, True], [1, None], 1j, [1 + 0j], np.array([True]), np.array(["1"]), np.array([1j]),
     np.array([1, 2], dtype=object), np.ma.masked_less([1.0, 2.0], 1.5), [[1], [1, 2]], [1, math.nan], math.inf, {},
     None],
)  # fmt: skip
def test_no_numbers(values):
    with pytest.raises(ValueError, match="x must be two numbers, not "):
        numbers("x", values, "two numbers")


def test_numbers_of_every_type_are_floats_in_their_shape():
    for values in (3, [1, 2.5], np.arange(6, dtype=np.uint8).reshape(2, 3), ((1, 2), (3, np.float32(4)))):
        found = numbers("x", values, "numbers")
        assert found.dtype == float and np.array_equal(found, np.array(values))
    assert np.isnan(numbers("x", [1, math.nan], "numbers", finite=False)).tolist() == [False, True]
    for wrong in ([1], [1, 2, 3], [[1, 2]], 1):
        with pytest.raises(ValueError, match="x must be two numbers, not"):
            numbers("x", wrong, "two numbers", 2)


@pytest.mark.parametrize("value", [0, True, 1.0, "2", None])
def test_no_number_of_workers(value):
    assert workers(-1) == -1 and workers(np.int64(3)) == 3
    with pytest.raises(ValueError, match=f"n_jobs must be 1, 2, … processes or -1 for one per core, not {value!r}"):
        workers(value)


PACKAGES = ("structures", "mechanics", "descriptors", "datasets", "diffusion", "models", "experiments", "alternatives")
PACKAGES += ("inverse", "io")
RESULTS = {
    "Design",
    "Designs",
    "Descriptors",
    "Inflation",
    "Model",
    "Shape",
    "TrainedModel",
}  # nobody makes these by hand


def numeric_arguments():
    """(function, argument) of every number that is given to a public function, or to make an object of a class."""
    for package in PACKAGES:
        module = importlib.import_module(f"inflate_lib.{package}")
        for name in sorted({*module.__all__} - RESULTS):
            function = getattr(module, name)
            for argument, about in inspect.signature(function).parameters.items() if callable(function) else ():
                kind = about.annotation
                kinds = set(typing.get_args(kind)) if isinstance(kind, types.UnionType) else {kind}
                if kinds <= {int, float, type(None)}:
                    yield pytest.param(function, argument, id=f"{package}.{name}-{argument}")


@pytest.fixture(scope="module")
def given():
    """Something for every argument that is not looked at before the numbers."""
    image = np.pad(np.ones((8, 8)), 10)
    return {
        "image": image,
        "images": image[None],
        "label": label_image(image),
        "result": inflate(label_image(image), n_steps=1),
        "hull": np.array([(0, 0), (1, 0), (0, 1.0)]),
        "matrix": np.arange(9.0)[:, None],
        "descriptor": "height",
        "targets": {"height": 1.0},
        "name": "height",
        "source": "digits",
        "n": 1,
        "n_conditions": 1,
    }


@pytest.mark.parametrize(("function", "argument"), numeric_arguments())
def test_no_public_function_takes_something_else_for_a_number(function, argument, given):
    needed = {
        name: given.get(name)
        for name, about in inspect.signature(function).parameters.items()
        if about.default is inspect.Parameter.empty and about.kind != inspect.Parameter.VAR_KEYWORD
    }
    if function.__name__ == "TrainingConfig" and argument not in ("steps", "epochs"):
        needed["steps"] = 1
    if function.__name__ == "Recipe":
        needed |= {"source": "digits", "training": {"steps": 1}, "sampling": {}, "seed": 0, "n_structures": None}
        needed |= {"n_augmented": 1, "n_calibration": 0}
    for value in (True, np.True_, "1", math.nan, 1j, [1]):
        with pytest.raises(ValueError, match=rf"{argument}\b"):
            function(**needed | {argument: value})


@pytest.mark.parametrize(
    "wrong",
    [
        {"pressure": True}, {"pressure": "0.01"}, {"pressure": [0.01, True]}, {"pressure": np.array([True])},
        {"pressure": 1j}, {"pressure": np.ma.masked_less([0.01, 0.02], 0.015)}, {"lame": "12"}, {"lame": ("1", "2")},
        {"lame": (True, 1)}, {"lame": (1 + 0j, 1)}, {"lame": (math.inf, 1)}, {"lame": np.array([[1, 2]])},
    ],
)  # fmt: skip
def test_pressures_and_moduli_are_numbers(given, wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be "):
        inflate(given["label"], **wrong)


@pytest.mark.parametrize("wrong", [(True, 0, 1, 1), ("0", "0", "1", "1"), "0123", (0, 0, 1), (0, 0, 1, 1j)])
def test_a_region_to_keep_out_of_is_four_numbers(wrong):
    for make in (lambda: Constraints(keep_out=wrong), lambda: from_millimetres(100, keep_out=wrong)):
        with pytest.raises(ValueError, match="keep_out must be four numbers"):
            make()


@pytest.mark.parametrize("change", [lambda a: 1j * a, lambda a: a.astype(str), lambda a: np.ma.array(a, mask=a > 0)])
def test_a_label_image_is_of_numbers(given, change):
    with pytest.raises(ValueError, match="label must be an array of 0"):
        build_mesh(change(given["label"]))
