"""YAML read strictly: a key given twice is an error, and a number that YAML takes for text is pointed out."""

from pathlib import Path
from typing import Any

import yaml


def read_yaml(path: Path) -> Any:
    """The content of a file.

    Raises
    ------
    ValueError
        It is not YAML, or gives a key twice. The message names it.
    """
    try:
        return yaml.load(Path(path).read_text(encoding="utf-8"), Loader=_StrictLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from error


def hint(value: Any) -> str:
    """What to write instead of a number that YAML reads as text, such as 1e-3; else an empty text."""
    if not isinstance(value, str):
        return ""
    try:
        float(value)
    except ValueError:
        return ""
    mantissa, exponential, exponent = value.lower().partition("e")
    better = f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if exponential else value
    return f"; YAML reads {value} as text: write {better}"


class _StrictLoader(yaml.SafeLoader):
    """YAML that refuses a key given twice instead of keeping the last."""

    def construct_mapping(self, node, deep=False):
        keys = [key.value for key, _ in node.value]
        for key, _ in node.value:
            if keys.count(key.value) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is given twice", key.start_mark)
        return super().construct_mapping(node, deep)
