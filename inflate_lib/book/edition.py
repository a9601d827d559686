"""The published edition: the pictures and tables of one run of the laptop profile, which git keeps.

A run writes to ``figures/runs/<profile>/``, which git ignores: the last digits of a number, and with them the bytes of
a picture, differ from one machine to the next. The edition in ``figures/laptop/`` changes when somebody publishes one,
and at no other time.
"""

import json
import shutil

from inflate_lib import paths
from inflate_lib._files import draft
from inflate_lib.book.run import RunError, plan
from inflate_lib.models.recipe import EDITION

_KEPT = (".png", ".csv")  # an SVG is mostly larger than its PNG, and every run makes it


def publish_edition() -> None:
    """Replace ``figures/laptop/`` by the pictures and tables of the last run of its profile, with their records.

    A record that differs from the edition's in its commit alone leaves that one as it is.

    Raises
    ------
    RunError
        A notebook is not fresh, or a record comes from the embedded digits or from code that was not committed.
        Nothing is changed then.
    """
    run, jobs = paths.FIGURES / EDITION, plan(EDITION)
    problems = [f"{job.name}: {why}" for job in jobs if (why := job.stale())]
    notes = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(run.glob("*.json"))]
    notes = [note for note in notes if note["notebook"] in {job.name for job in jobs}]
    problems += [f"{note['name']}: made from the embedded digits" for note in notes if note["data_source"] == "digits"]
    problems += [
        f"{note['name']}: made by code that was not committed" for note in notes if note["uncommitted_changes"]
    ]
    if problems:
        raise RunError("\n".join(["no edition can be published yet:", *(f"  {problem}" for problem in problems)]))
    before = _recorded()
    published = set()
    for note in notes:
        note["files"] = {file: content for file, content in note["files"].items() if file.endswith(_KEPT)}
        if note["files"]:
            _publish(note, run)
            published |= {*note["files"], f"{note['name']}.json"}
    for name in before - published:
        (paths.EDITION / name).unlink(missing_ok=True)


def _recorded():
    """Names of the files of the edition that is there: its records, and what they list. All else is not ours."""
    names = set()
    for record in paths.EDITION.glob("*.json"):
        note = json.loads(record.read_text(encoding="utf-8"))
        if "notebook" in note:
            names |= {record.name, *note["files"]}
    return names


def _publish(note, run):
    record = paths.EDITION / f"{note['name']}.json"
    if record.is_file() and {**json.loads(record.read_text(encoding="utf-8")), "commit": note["commit"]} == note:
        return
    for file in note["files"]:
        with draft(paths.EDITION / file) as place:
            shutil.copyfile(run / file, place)
    with draft(record) as place:
        place.write_text(json.dumps(note, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
