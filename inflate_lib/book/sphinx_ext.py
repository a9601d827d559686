"""The frame of the book, as a Sphinx extension: every page says which run it comes from.

A page that was computed carries a badge below its title, with the profile and the data that its executed notebook
names; every page a footer with profile, commit and date. Published tables have numbers and captions, as figures do.
Besides, it brings what depends on the run into pages that do not: the picture on the first page, the explorer's data,
and the model cards of the committed weights; and into the reference what each package makes public.
"""

import os
import pkgutil
import pydoc
import re
from datetime import date
from importlib import import_module
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from PIL import Image
from sphinx.transforms import SphinxTransform

from inflate_lib import paths
from inflate_lib._provenance import code_state
from inflate_lib.book.findings import FindingsBox
from inflate_lib.book.page import SOURCES, recorded
from inflate_lib.book.profiles import ProfileError, load_profile
from inflate_lib.book.run import executed_under
from inflate_lib.plotting.style import TEXT_WIDTH

_HERO_NOTEBOOK = "22_explorer"
_HERO = "glance"  # published by it
_EXPLORER = "explorer_data"  # likewise
_SHEET = "explorer_sheet"  # likewise: what the laboratory shows where no scripts run
_SHEET_TEXT = "Inflated structures for nine targets, each with the target and the value achieved"
_HERO_TEXT = "From a wanted size to structures that have it: target, denoising, structures, inflated structures"
_HERO_CAPTION = (
    "From a target to three different structures drawn for it, one in each row: the target height; noise that a "
    "network turns into an image; the structure read from it, with wall and void; and that structure inflated, with "
    "the target dashed and the achieved height below."
)
_HERO_ERROR = "{glance_n} structures were drawn for this height; their median error is {glance_error_percent:.1f} %."
_TABLE = "tab-"  # how the name of a published table begins, for {numref}
_MODEL_CARDS = "<!-- model cards -->"  # in a page: replaced by the README of each folder of weights
_NO_WEIGHTS = "No weights are committed at the moment: the models are trained when a notebook first needs them."


def badge(stamp: dict[str, str]) -> nodes.Node:
    """The line below a title that tells a ci number from a paper number at a glance."""
    try:
        description = load_profile(stamp["profile"]).description
    except ProfileError:  # one of the tests' own
        description = ""
    rest = [description] if description else []
    rest += [SOURCES.get(stamp["source"], stamp["source"])] if stamp["source"] else []
    name = nodes.inline(text=f"{stamp['profile']} profile", classes=["profile-name"])
    line = nodes.paragraph("", "", name, nodes.Text(" " + " · ".join(rest)))
    return nodes.container("", line, classes=["profile-badge", f"profile-{stamp['profile']}"])


def footer(profile: str) -> str:
    """Profile, commit and date, as HTML."""
    state = code_state()
    commit = state["commit"][:10] + (" with uncommitted changes" if state["uncommitted_changes"] else "")
    today = date.today().isoformat()
    return f"<p>Computed under the profile <strong>{profile}</strong> · commit {commit} · {today}</p>"


def _model_cards() -> list[Path]:
    """The README of each folder in data/pretrained that has one."""
    return sorted(paths.PRETRAINED.glob("*/README.md"))


class _CaptionedTable(nodes.figure):
    """A published table: a figure that counts as a table. Its caption stays put where the table scrolls."""


class _TableCaption(nodes.caption):
    """The caption above a table, closed at its end; Sphinx leaves that of a figure open, for a legend."""


def _visit_table(writer, node):
    writer.visit_figure(node)


def _depart_table(writer, node):
    writer.body.append("</figure>\n")


def _visit_table_caption(writer, node):
    writer.visit_caption(node)


def _depart_table_caption(writer, node):
    writer.body.append("</span>")
    writer.add_permalink_ref(node.parent, "Link to this table")
    writer.body.append("</p>\n</figcaption>\n")


class _CaptionTables(SphinxTransform):
    """MyST-NB puts what a cell shows into a figure, if the cell names one: a name ``tab-…`` makes that a table."""

    default_priority = 500  # before Sphinx notes what can be referred to

    def apply(self):
        for figure in list(self.document.findall(nodes.figure)):
            if not any(name.startswith(_TABLE) for name in figure["names"]):
                continue
            table = _CaptionedTable("", **figure.attributes)
            table["classes"] += ["captioned-table"]
            for part in figure.children:
                if isinstance(part, nodes.caption):
                    table.insert(0, _TableCaption(part.rawsource, "", *part.children, **part.attributes))
                else:
                    table += part
            figure.replace_self(table)
            self.document.ids.update(dict.fromkeys(table["ids"], table))


class _PublicApi(Directive):
    """``.. public:: package``: what a package is for, the names that it hands on, and all its public modules."""

    required_arguments = 1

    def run(self):
        package = import_module(self.arguments[0])
        parts = (module.name for module in pkgutil.iter_modules(getattr(package, "__path__", ())))
        modules = [f"{package.__name__}.{part}" for part in parts if not part.startswith("_")]
        lines = [f".. automodule:: {package.__name__}"]
        if modules:
            names = ", ".join(f"``{name}``" for name in package.__all__)
            lines += ["   :no-members:", "", f"The package hands on {names}.", ""]
        for module in modules:
            lines += [f".. rubric:: ``{module}``", "", f".. automodule:: {module}", ""]
        place = nodes.Element()
        self.state.nested_parse(StringList(lines, source=package.__name__), self.content_offset, place)
        return place.children


def _configure(app, config):
    stamps = [stamp for path in sorted(paths.EXECUTED.glob("*.ipynb")) if (stamp := executed_under(path))]
    profile = stamps[0]["profile"] if stamps else "none"
    config.html_theme_options = {**config.html_theme_options, "extra_footer": footer(profile)}
    hero, sheet = (Path(os.path.relpath(paths.FIGURES / profile / f"{n}.png", paths.BOOK)) for n in (_HERO, _SHEET))
    notebook = paths.EXECUTED / f"{_HERO_NOTEBOOK}.ipynb"
    measured = recorded(notebook) if notebook.is_file() else {}
    error = "glance_n" in measured and _HERO_ERROR.format(**measured)
    caption = f"{_HERO_CAPTION} {error or ''} Drawn from results of this book's run (profile {profile})."
    pictures = {
        "hero": (hero, f"```{{figure}} {hero.as_posix()}\n:alt: {_HERO_TEXT}\n:name: fig-glance\n\n{caption}\n```"),
        "explorer_sheet": (sheet, f"```{{image}} {sheet.as_posix()}\n:alt: {_SHEET_TEXT}\n```"),
    }
    shown = {name: text if (paths.BOOK / file).is_file() else "" for name, (file, text) in pictures.items()}
    config.myst_substitutions = {**config.myst_substitutions, **shown}
    scripts = [paths.FIGURES / profile / f"{_EXPLORER}.js", *sorted((paths.ROOT / "lab" / "built").glob("*.js"))]
    config.html_static_path = [*config.html_static_path, *(str(script) for script in scripts if script.is_file())]


def _add_badge(app, doctree):
    stamp = executed_under(Path(app.env.doc2path(app.env.docname)))
    title = next(iter(doctree.findall(nodes.title)), None)
    if stamp and title:
        title.parent.insert(title.parent.index(title) + 1, badge(stamp))


def _size_pictures(app, doctree):
    """A figure is as wide as it was drawn, so that letters have one size on all; a phone scrolls wide ones sideways."""
    for picture in list(doctree.findall(nodes.image)):
        file = Path(app.srcdir, picture["uri"])
        if file.suffix == ".png" and file.is_file():
            with Image.open(file) as opened:
                wide = opened.width > 2 * opened.height
                inches = opened.width / opened.info.get("dpi", (100, 100))[0]
            picture["width"] = f"{min(100, round(100 * 2.54 * inches / TEXT_WIDTH))}%"
            if wide:
                box = nodes.container(classes=["wide-picture"])
                picture.replace_self(box)
                box += picture


def _typeset(number: str) -> str:
    """A number of the run as in print: ``-2.4e-09`` becomes −2.4 · 10⁻⁹."""
    powers = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    number = re.sub(r"(\d)e\+?(-?)0*(\d+)", lambda m: f"{m[1]} · 10" + (m[2] + m[3]).translate(powers), number)
    return re.sub(r"(?<!\w)-(?=\d)", "−", number).replace(" · ", "\u00a0·\u00a0")


def _keep_together(app, doctree, docname):
    """Set the run's numbers as in print; break no line before a percent sign or between a formula and its comma."""
    for parent in list(doctree.findall(nodes.TextElement)):
        if isinstance(parent, nodes.FixedTextElement | nodes.literal | nodes.math):
            continue
        of_the_run = "pasted-text" in parent["classes"]
        for at, child in enumerate(parent):
            if isinstance(child, nodes.Text):
                parent[at] = nodes.Text(_typeset(child) if of_the_run else child.replace(" %", "\u00a0%"))
            elif isinstance(child, nodes.math):
                after = parent[at + 1] if at + 1 < len(parent) else None
                mark = re.match(r"[.,;:!?)]+", after) if isinstance(after, nodes.Text) else None
                if mark:
                    parent[at + 1] = nodes.Text(after[mark.end() :])
                    parent[at] = nodes.inline("", "", child, nodes.Text(mark[0]), classes=["unbroken"])


def _add_model_cards(app, docname, source):
    if _MODEL_CARDS not in source[0]:
        return
    for card in _model_cards():
        app.env.note_dependency(str(card))
    texts = [_one_level_down(card.read_text(encoding="utf-8")) for card in _model_cards()]
    source[0] = source[0].replace(_MODEL_CARDS, "\n\n".join(texts or [_NO_WEIGHTS]))


def _one_level_down(text: str) -> str:
    """Markdown with its headings, but not the comments in its code, one level lower."""
    pieces = text.split("```")
    pieces[::2] = [re.sub(r"^#", "##", piece, flags=re.MULTILINE) for piece in pieces[::2]]
    return "```".join(pieces)


def _resolve_public_name(app, env, node, contnode):
    """`inflate_lib.inflate` is documented in the module that it is defined in; the same for `inflate_lib.diffusion`."""
    ours = node.get("refdomain") == "py" and node["reftarget"].startswith("inflate_lib.")
    found = pydoc.locate(node["reftarget"]) if ours else None
    module, name = getattr(found, "__module__", None), getattr(found, "__qualname__", None)
    target = f"{module}.{name}"
    if not module or not name or target == node["reftarget"]:
        return None
    place = node.get("refdoc", env.docname), app.builder, node["reftype"], target, node, contnode
    return env.get_domain("py").resolve_xref(env, *place)


def _leave_out_thebe(app, page, template, context, doctree):
    """Jupyter Book puts the scripts of a launch button that we do not offer on every page, twice: an error there."""
    scripts = context.get("script_files", [])
    context["script_files"] = [script for script in scripts if "thebe" not in f"{script.filename} {script.attributes}"]


def setup(app):
    """Connect to Sphinx."""
    app.add_enumerable_node(_CaptionedTable, "table", html=(_visit_table, _depart_table))
    app.add_node(_TableCaption, html=(_visit_table_caption, _depart_table_caption))
    app.add_transform(_CaptionTables)
    app.add_directive("public", _PublicApi)
    app.add_directive("findings", FindingsBox)
    app.connect("config-inited", _configure, priority=400)
    app.connect("source-read", _add_model_cards)
    app.connect("doctree-read", _add_badge)
    app.connect("doctree-read", _size_pictures)
    app.connect("doctree-resolved", _keep_together)
    app.connect("missing-reference", _resolve_public_name)
    app.connect("html-page-context", _leave_out_thebe)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
