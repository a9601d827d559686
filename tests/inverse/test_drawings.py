"""What of an SVG file is an outline: the curve that is painted, in the user units of the file."""

import gzip

import numpy as np
import pytest

from inflate_lib.inverse.drawings import OPEN, read_outline
from inflate_lib.inverse.targets import as_targets, read_targets

BODY = '<rect x="10" y="20" width="30" height="60"/>'
BOX = [10, 20, 40, 80]  # left, top, right, bottom of it


def box(path, body, head='viewBox="0 0 100 100"'):
    """Left, top, right and bottom of the outline in a file, in user units."""
    spaces = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    file = path / "a.svg"
    file.write_text(f"<svg {spaces} {head}>{body}</svg>")
    points = read_outline(file, unit=1) * [1, -1]
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


@pytest.mark.parametrize(
    "body",
    [
        '<rect fill="none" stroke="none" width="100" height="100"/>',
        '<circle visibility="hidden" cx="50" cy="50" r="5"/>',
        '<g visibility="hidden"><circle visibility="collapse" r="5"/></g>',
        '<g display="none"><circle display="inline" r="5"/></g>',
        '<g opacity="0"><circle opacity="1" r="5"/></g>',
        '<g style="opacity: 0%"><circle r="5"/></g>',
        '<g fill-opacity="0"><circle r="5"/></g>',
        '<circle style="fill:transparent;stroke:red;stroke-width:0" r="5"/>',
        '<circle fill="#12345600" stroke="red" stroke-opacity="0" r="5"/>',
        '<circle fill="rgba(9, 9, 9, 0)" r="5"/>',
        '<circle fill="rgb(9 9 9 / 0%)" r="5"/>',
        '<circle opacity="-1" r="5"/>',
        "<style>/* ! */ .a, path.b { fill: none !important }</style><circle class='c a' style='fill:red' r='5'/>",
        '<marker id="m"><path d="M0 0 L5 5 L0 5z"/></marker>',
        '<mask id="m"><rect width="100" height="100"/></mask>',
        '<clipPath id="m"><rect width="100" height="100"/></clipPath>',
        '<pattern id="m" width="9" height="9"><rect width="9" height="9"/></pattern>',
        '<symbol id="m"><rect width="9" height="9"/></symbol>',
        '<defs><rect id="m" width="9" height="9"/></defs>',
        '<metadata><rect width="9" height="9"/></metadata>',
        '<path xmlns="https://elsewhere.org" d="M0 0 L5 5 L0 5z"/>',
        '<path d="M5 5"/><path d="M5 5 M6 6 z"/><path d=""/><path/><polyline points=""/>',
        '<line x2="50" y2="50"/><path d="M0 0 L5 5 z"/>',  # filled alone, these have no area
        '<rect width="0" height="5"/><circle r="0"/><ellipse rx="5" ry="0"/>',
        '<text x="5" y="5">7</text><title>a seven</title>',
        '<rect id="h" visibility="hidden" width="9" height="9"/><use href="#h"/>',
        '<g fill="none"><circle fill="inherit" r="5"/></g>',
        '<switch><circle requiredExtensions="https://elsewhere.org" r="5"/><g/><circle r="5"/></switch>',
    ],
)
def test_what_is_not_painted_is_no_curve(tmp_path, body):
    assert box(tmp_path, body + BODY).tolist() == BOX
    assert box(tmp_path, BODY + body).tolist() == BOX


@pytest.mark.parametrize(
    "body",
    [
        '<g visibility="hidden"><rect visibility="visible" x="10" y="20" width="30" height="60"/></g>',
        '<path d="M10 20 h30 v60 h-30 z" fill="none" stroke="black"/>',
        '<defs><rect id="a" width="30" height="60"/></defs><use href="#a" x="10" y="20"/>',
        '<defs><g id="a"><rect width="3" height="6"/></g></defs>'
        '<use xlink:href="#a" transform="scale(10)" x="1" y="2"/>',
        '<defs><path id="a" d="M0 0h3v6h-3z"/><use id="b" href="#a" x="1"/></defs>'
        '<g transform="scale(10)"><use href="#b" y="2"/></g>',
        '<symbol id="a" viewBox="0 0 10 20"><rect y="2" x="2" width="6" height="12"/></symbol>'
        '<use href="#a" y="10" width="50" height="100"/>',
        '<symbol id="a"><rect x="10" y="20" width="30" height="60"/></symbol><use href="#a"/>',
        '<svg x="5" y="10" width="40" height="80"><rect x="5" y="10" width="30" height="60"/></svg>',
        '<svg x="10%" y="20%" width="30%" height="60%" viewBox="0 0 7 7" preserveAspectRatio="none">'
        '<rect width="100%" height="100%"/></svg>',
        '<g fill="none"><g style="fill:url(#shade)"><rect x="10" y="20" width="30" height="60"/></g></g>',
        '<g clip-path="url(#c)"><rect x="10" y="20" width="30" height="60"/></g>'
        '<clipPath id="c"><rect width="100" height="100"/></clipPath>',
        '<g transform="translate(40 80) rotate(180)"><g transform="scale(2, 3)"><rect width="15" height="20"/></g></g>',
        '<g transform="matrix(0 2 -2 0 40 20)"><rect width="30" height="15"/></g>',
        '<style>#a { width: 30px; height: 60px } rect { x: 10px; y: 20px; width: 5px }</style><rect id="a"/>',
    ],
)
def test_what_is_painted_is_read_where_it_is_painted(tmp_path, body):
    assert np.allclose(box(tmp_path, body), BOX, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("head", "body", "expected"),
    [
        ('viewBox="0 0 900 400"', '<rect x="10%" y="10%" width="80%" height="90%"/>', [90, 40, 810, 400]),
        ('viewBox="-9 -9 900 400" width="9mm"', '<rect width="50%" height="50%"/>', [0, 0, 450, 200]),
        ('width="900" height="400px"', '<rect x="10%" y="10%" width="80%" height="90%"/>', [90, 40, 810, 400]),
        ('viewBox="0 0 70 10"', '<circle cx="50%" cy="50%" r="20%"/>', [25, -5, 45, 15]),  # √((70² + 10²)/2) = 50
        ('viewBox="0 0 70 10"', '<ellipse rx="10%" ry="10%"/>', [-7, -1, 7, 1]),
        (
            'viewBox="0 0 70 10"',
            '<svg width="50%" viewBox="0 0 4 4"><rect width="50%" height="50%"/></svg>',
            [12.5, 0, 17.5, 5],
        ),
        ("", '<rect x="1in" y="2.54cm" width="25.4mm" height="72pt"/>', [96, 96, 192, 192]),
        ("", '<rect x="6pc" y="101.6q" width="96px" height="9.6e1"/>', [96, 96, 192, 192]),
        ('font-size="20"', '<rect width="1em" height="2ex"/>', [0, 0, 20, 20]),
        (
            'style="font-size: 10px"',
            '<g font-size="2em"><rect font-size="50%" width="1em" height="4ch"/></g>',
            [0, 0, 10, 20],
        ),
    ],
)
def test_lengths_in_every_unit(tmp_path, head, body, expected):
    assert np.allclose(box(tmp_path, body, head), expected, rtol=0, atol=1e-12)


def test_a_sheared_arc_stays_an_ellipse(tmp_path):
    """x′ = A x with |x| = r reaches r √(AAᵀ)₁₁ to the side and r √(AAᵀ)₂₂ up."""
    A = np.array([[1.5, -0.4], [0.7, 1.1]])
    text = "matrix({0} {2} {1} {3} 5 6)".format(*A.ravel())
    reach = 20 * np.sqrt(np.diag(A @ A.T))
    for body in ('<circle r="20"', '<path d="M-20 0 A 20 20 0 0 1 20 0 A 20 20 0 0 1 -20 0 z"'):
        found = box(tmp_path, f'{body} transform="{text}"/>')
        assert np.allclose(found, [5 - reach[0], 6 - reach[1], 5 + reach[0], 6 + reach[1]], rtol=1e-3)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (BODY + '<circle id="eye" r="5"/>', "2 separate curves are painted, .rect, circle eye.; one outline"),
        ('<rect width="50%" height="5"/>', "'50%' is relative to the size of the drawing"),
        ('<rect width="5vw" height="5"/>', "the length '5vw' is not supported"),
        ('<rect width="calc(1px + 2px)" height="5"/>', "is not supported"),
        ('<use href="#there"/>', "a use refers to '#there', which is not in the file"),
        ('<use href="other.svg#a"/>', "which is not in the file"),
        ('<g id="a"><use href="#a"/></g>', "a use refers to '#a', which holds that use"),
        (f'<mask id="m"/><g mask="url(#m)">{BODY}</g>', "rect: a mask says which part of it is painted"),
        (
            f'<clipPath id="m"><circle r="30"/></clipPath><g clip-path="url(#m)">{BODY}</g>',
            "rect: it is cut by a clip path",
        ),
        (f'<svg width="35" height="90">{BODY}</svg>', "the border of a nested drawing"),
        (f'<g clip-path="circle(9px)">{BODY}</g>', "clip paths of a single curve"),
        (f"<style>g > rect {{ fill: none }}</style>{BODY}", "the selector 'g > rect', which is not supported"),
        (f"<style>@media print {{ rect {{ fill: none }} }}</style>{BODY}", "its style sheet has @media"),
        (f'<g style="scale: 0.5">{BODY}</g>', "the property scale is not supported"),
        ('<path d="M0 0 L10"/>', "path cannot be read"),
        ('<path d="M0 0 L1e999 0 L5 5 z"/>', "not finite"),
        ("<text>7</text>", "the outline is empty"),
        ("<g>" * 3000 + BODY + "</g>" * 3000, "nested too deeply"),
    ],
)
def test_what_cannot_be_told_is_said(tmp_path, body, message):
    with pytest.raises(ValueError, match=message) as refused:
        box(tmp_path, body, "")
    assert str(refused.value).startswith(str(tmp_path / "a.svg"))


def test_a_compressed_file_is_read(tmp_path):
    (tmp_path / "a.SVGZ").write_bytes(gzip.compress(f"<svg>{BODY}</svg>".encode()))
    assert np.ptp(read_outline(tmp_path / "a.SVGZ", unit=10), axis=0).tolist() == [3, 6]


@pytest.mark.parametrize("end", ["", "50.00001,9.99999", "50.3,9.7", "50,10", "49.9,10.2 50.2,9.9", "50.00000001,10"])
@pytest.mark.parametrize("shift", range(3))
def test_an_end_that_misses_the_beginning_by_rounding_closes(end, shift):
    corners = np.roll([(50, 10), (90, 100), (10, 100)], shift, axis=0)
    moved = np.array([text.split(",") for text in end.split()], dtype=float).reshape(-1, 2) - (50, 10) + corners[0]
    asked = as_targets({"outline": np.concatenate([corners, moved]) / 100})
    exact = as_targets({"outline": corners / 100})
    assert [asked.height, asked.width, asked.area] == pytest.approx([exact.height, exact.width, exact.area], rel=OPEN)


@pytest.mark.parametrize(
    ("head", "units"), [("", "nan"), ('width="10cm"', "3.7795"), ('width="9mm" viewBox="0 0 90 9"', "10")]
)
def test_it_is_said_how_a_drawing_was_measured(tmp_path, head, units):
    box(tmp_path, BODY, head)
    measured = read_targets(outline=tmp_path / "a.svg", unit=50).measured
    assert "a.svg is 30 user units wide and 60 high, and 50 of them were taken as a side of the frame" in measured
    assert (f"a millimetre is {units} of them" in measured) == (units != "nan")
