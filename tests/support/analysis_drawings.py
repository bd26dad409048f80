"""Records what matplotlib would draw, without drawing it."""

from matplotlib.figure import Figure


def keep(monkeypatch):
    """Keeps figures by the name of their file instead of writing them."""
    figures = {}
    monkeypatch.setattr(
        Figure, "savefig", lambda self, path, **_: figures.update({path.name: self})
    )
    return figures


def lines(axes):
    """The y values of every line, by label."""
    return {line.get_label(): line.get_ydata() for line in axes.lines}


def pictures(figure):
    """The content of every panel, in order."""
    return [axes.get_images()[0].get_array() for axes in figure.axes]
