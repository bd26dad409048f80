"""The table of drills names tests that exist and all drills of the program."""

import ast
import pathlib
import re

import drills

TESTS = pathlib.Path(__file__).parents[1]


def functions(module):
    tree = ast.parse((TESTS / f"{module}.py").read_text())
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_drill_names_its_tests():
    parts = re.split(r"^ ?(\d+)  ", drills.__doc__, flags=re.MULTILINE)[1:]
    numbers, texts = parts[::2], parts[1::2]
    assert numbers == [str(number) for number in range(1, 22)]
    named = {}
    for number, text in zip(numbers, texts, strict=True):
        found = re.findall(r"^ {8}([\w/]+)::(\w+)$", text, flags=re.MULTILINE)
        assert found, f"drill {number} names no test"
        assert len(found) == text.rstrip().count("\n"), f"drill {number}: a line is not a test"
        for module, name in found:
            named.setdefault(module, set()).add(name)
    for module, names in named.items():
        assert not names - functions(module), module
    assert named["support/drills"] == set(drills.DRILLS)
