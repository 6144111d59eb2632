"""The pictures of an identification."""

from __future__ import annotations

from pathlib import Path

from sil.identify.estimate import Identified


def draw(found: Identified, path: Path) -> None:
    """Draw all panels into one PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        1, len(found.panels), figsize=(6.4 * len(found.panels), 4.6), squeeze=False
    )
    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
    for axis, panel in zip(axes[0], found.panels, strict=True):
        for k, curve in enumerate(panel.curves):
            colour = colours[k % len(colours)]
            if curve.kind == "points":
                axis.plot(curve.x, curve.y, ".", ms=2, alpha=0.4, color=colour, label=curve.label)
            else:
                axis.plot(curve.x, curve.y, "-", lw=1.8, color=colour, label=curve.label)
        axis.set_title(panel.title)
        axis.set_xlabel(panel.x_label)
        axis.set_ylabel(panel.y_label)
        axis.grid(alpha=0.3)
        axis.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
