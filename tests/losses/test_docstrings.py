"""Every loss documents its source, arguments, results and gradients."""

import inspect
import re

import pytest

from vawm import losses

FUNCTIONS = {
    name: function
    for name in losses.__all__
    if inspect.isfunction(function := getattr(losses, name))
}
SOURCE = re.compile(r"Eq\. \d|(et al\.|Farahmand), \d{4}|derived here|DreamerV3|STORM")


def section(text, name):
    """The indented lines below `name:`, without the indentation; None if there is none."""
    found = re.search(rf"^{name}:\n((?:[ ]+.*\n?|\n(?=[ ]))+)", text, re.MULTILINE)
    return inspect.cleandoc(found[1]) if found else None


def test_there_are_functions_to_document():
    assert {"value_alignment_loss", "vaml_loss", "symlog"} < set(FUNCTIONS)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_docstring_names_source_arguments_result_and_errors(name):
    function, text = FUNCTIONS[name], inspect.getdoc(FUNCTIONS[name])
    assert SOURCE.search(text)
    arguments = re.findall(r"^(\w+): ", section(text, "Args") or "", re.MULTILINE)
    assert arguments == list(inspect.signature(function).parameters)
    assert section(text, "Returns")
    if re.search(r"chex\.assert|raise ", inspect.getsource(function)):
        assert section(text, "Raises")


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_docstring_names_shapes_and_gradients(name):
    text = inspect.getdoc(FUNCTIONS[name])
    assert re.search(r"`\[[^`]*\]`", section(text, "Returns"))
    if name != "init_return_scale":  # of constants
        assert re.search(r"stop|gradient", text)


@pytest.mark.parametrize("kind", [losses.PredictionLoss, losses.ReturnScale])
def test_a_result_with_parts_documents_their_shapes_and_its_equation(kind):
    assert re.search(r"Eq\. \d", kind.__doc__)
    assert "`[...]`" in kind.__doc__ or "# [] float32" in inspect.getsource(kind)
