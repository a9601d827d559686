"""Checks of arguments: what is let through, what is refused, and that the message names both sides."""

import math

import numpy as np
import pytest

from inflate_lib._checks import choice, flag, number, positive_number, whole_number


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
    with pytest.raises(ValueError, match=r"not 'fast'$"):
        number("rate", "fast", least=0)


def test_no_choice_and_no_flag():
    for value in ("DDIM", None, ["ddim"]):
        with pytest.raises(ValueError, match=r"sampler must be one of ddim, ancestral, not "):
            choice("sampler", value, ("ddim", "ancestral"))
    with pytest.raises(ValueError, match="symmetric must be true or false, not 1"):
        flag("symmetric", 1)
