"""Show a figure on a screen, where there is one."""

from matplotlib.figure import Figure

from minislam.errors import InputError


def show_figure(figure: Figure) -> None:
    """Open a window with a figure and wait until it is closed."""
    from matplotlib import pyplot  # only here: pyplot looks for a screen when it is imported
    from matplotlib.backends import backend_registry
    from matplotlib.backends.registry import BackendFilter

    backend = pyplot.get_backend().lower()
    if backend not in backend_registry.list_builtin(BackendFilter.INTERACTIVE):
        raise InputError(
            "expected a display to plot on, found none; write the plot to a file with "
            "--save_plot FILE"
        )
    window = pyplot.figure(figsize=figure.get_size_inches(), dpi=figure.dpi)
    figure.canvas.draw()
    window.figimage(figure.canvas.buffer_rgba())
    pyplot.show()
