"""YAML files whose errors name the line."""

import difflib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

#: Where something stands in a document: the keys and numbers that lead to it.
Place = tuple[str | int, ...]
#: YAML 1.1 takes a number with an exponent for text, unless it has a dot and the exponent a sign.
_NUMBER_AS_TEXT = re.compile(r"[-+]?[\d_]+(\.[\d_]*)?[eE][-+]?\d+")


class SpecError(ValueError):
    """A spec is wrong; the message says where, and what to write instead."""


class Document:
    """
    A YAML file as plain data, and the lines that it came from.

    :param name: what errors call it
    :param text: its content
    :raises SpecError: if it is not YAML, has a key twice, or a number that YAML takes for text
    """

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self.text = text
        self.lines: dict[Place, int] = {}
        try:
            root = yaml.compose(text, Loader=yaml.SafeLoader)
            if root is not None:
                self._note_lines(root, ())
            self.data: Any = yaml.safe_load(text)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = f", line {mark.line + 1}" if mark else ""
            raise SpecError(f"{name}{line}: not YAML: {error.problem or error.context}.") from error
        except yaml.YAMLError as error:
            raise SpecError(f"{name}: not YAML: {error}.") from error

    def _note_lines(self, node: yaml.Node, place: Place) -> None:
        self.lines.setdefault(place, node.start_mark.line + 1)
        if isinstance(node, yaml.ScalarNode):
            if node.style is None and _NUMBER_AS_TEXT.fullmatch(node.value) and node.tag.endswith(":str"):
                raise self.error(
                    place, f"YAML takes {node.value} for text. Write it out, or as 1.0e-3: a dot, and a sign."
                )
        elif isinstance(node, yaml.SequenceNode):
            for index, item in enumerate(node.value):
                self._note_lines(item, (*place, index))
        elif isinstance(node, yaml.MappingNode):
            self._note_mapping(node, place)

    def _note_mapping(self, node: yaml.MappingNode, place: Place) -> None:
        own: set[str] = set()
        for key, value in node.value:
            if key.tag.endswith(":merge"):
                continue
            name = str(key.value)
            self.lines[(*place, name)] = key.start_mark.line + 1
            if name in own:
                raise self.error((*place, name), "is there twice.")
            own.add(name)
            self._note_lines(value, (*place, name))

    def error(self, place: Place, problem: str) -> SpecError:
        """
        :param place: what is wrong; of what stands nowhere (a missing key), whatever it is missing in
        :param problem: what is wrong with it
        :return: the error to raise
        """
        known = place
        while known and known not in self.lines:
            known = known[:-1]
        line = f", line {self.lines[known]}" if known in self.lines else ""
        return SpecError(f"{self.name}{line}: {_path(place)}{problem}")

    def mapping(self, place: Place, value: Any) -> dict[str, Any]:
        """
        :param place: where the value stands
        :param value: what must be a mapping with text as its keys
        :return: the value
        :raises SpecError: if it is not
        """
        if not isinstance(value, dict):
            raise self.error(place, f"must be a mapping of keys to values, got {value!r}.")
        for key in value:
            if not isinstance(key, str):
                raise self.error((*place, str(key)), f"must be text to be a key: write '{key}'.")
        return value

    def keys(
        self, place: Place, value: Any, known: Iterable[str], required: Iterable[str] = ()
    ) -> dict[str, Any]:
        """
        :param place: where the value stands
        :param value: what must be a mapping
        :param known: the keys that it may have
        :param required: those that it must have
        :return: the value
        :raises SpecError: if it has an unknown key, or lacks one
        """
        mapping = self.mapping(place, value)
        for key in mapping:
            self.choice((*place, key), key, known, "key")
        for key in required:
            if key not in mapping:
                raise self.error(place, f"has no {key}, which it must have.")
        return mapping

    def choice(self, place: Place, value: Any, known: Iterable[str], what: str) -> str:
        """
        :param place: where the value stands
        :param value: what must be one of the known ones
        :param known: what it may be
        :param what: what it is, in a word
        :return: the value
        :raises SpecError: if it is another
        """
        names = sorted(known)
        if not isinstance(value, str) or value not in names:
            close = difflib.get_close_matches(str(value), names, n=3 if len(names) > 100 else 1)
            hint = f" Did you mean {' or '.join(close)}?" if close else ""
            listed = f" Known are {', '.join(names)}." if len(names) <= 100 else ""
            raise self.error(place, f"there is no {what} {value!r}.{hint}{listed}")
        return value

    def integer(self, place: Place, value: Any, least: int) -> int:
        """
        :param place: where the value stands
        :param value: what must be an integer
        :param least: the smallest that it may be
        :return: the value
        :raises SpecError: if it is something else
        """
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise self.error(place, f"must be an integer of {least} or more, got {value!r}.")
        return value

    def sequence(self, place: Place, value: Any) -> list[Any]:
        """
        :param place: where the value stands
        :param value: what must be a list with something in it, and nothing twice
        :return: the value
        :raises SpecError: if it is something else
        """
        if not isinstance(value, list) or not value:
            raise self.error(place, f"must be a list with at least one entry, got {value!r}.")
        for index, item in enumerate(value):
            if item in value[:index]:
                raise self.error((*place, index), f"{item!r} is in the list twice.")
        return value


def read_document(path: Path) -> Document:
    """
    :param path: a YAML file
    :return: its content
    :raises SpecError: if it cannot be read
    """
    try:
        return Document(str(path), path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"{path} cannot be read: {error}.") from error


def _path(place: Place) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return f"{text.lstrip('.')}: " if text else ""
