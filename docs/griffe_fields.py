"""An extension of griffe: what describes a field, wherever it is written.

A field without a docstring beneath it is described by what its class says under `Attributes:`,
by the comment beside it, or by the base class that has it too.
"""

from __future__ import annotations

import io
import re
import tokenize
from typing import Any

import griffe

SECTION = re.compile(r"\n*^Attributes:\n(?:[ ]+.*\n?|\n(?=[ ]))*", re.MULTILINE)


class Fields(griffe.Extension):
    """`deter: Array  # [..., D]` gets the docstring `[..., D]`."""

    def on_class_members(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        fields = {name: field for name, field in cls.members.items() if field.is_attribute}
        told = described(cls)
        if cls.docstring and told and told.keys() <= fields.keys():
            cls.docstring.value = SECTION.sub("\n", cls.docstring.value).strip()
        else:
            told = {}
        for name, field in fields.items():
            assert isinstance(field, griffe.Attribute)
            text = told.get(name) or comment(field) or inherited(cls, name)
            if text and not field.docstring:
                field.docstring = griffe.Docstring(text, lineno=field.lineno, parent=field)


def described(cls: griffe.Class) -> dict[str, str]:
    """Field -> what the docstring of its class says of it under `Attributes:`."""
    sections = cls.docstring.parse("google", warnings=False) if cls.docstring else []
    found = (s for s in sections if s.kind is griffe.DocstringSectionKind.attributes)
    return {item.name: item.description for section in found for item in section.value}


def comment(field: griffe.Attribute) -> str:
    """The last comment in the lines of a field."""
    source = "".join(line + "\n" for line in field.lines)
    tokens = tokenize.generate_tokens(io.StringIO(source.lstrip()).readline)
    comments = [token.string for token in tokens if token.type == tokenize.COMMENT]
    return comments[-1].lstrip("# ") if comments else ""


def inherited(cls: griffe.Class, name: str) -> str:
    """What a base class in the same module says of the field."""
    for base in cls.bases:
        owner = cls.module.members.get(str(base))
        if isinstance(owner, griffe.Class) and name in owner.members:
            docstring = owner.members[name].docstring
            return docstring.value if docstring else ""
    return ""
