"""Training curves as a plot: errors, effective parameters, damping over iterations."""

from pathlib import Path


def figure(curves: dict[str, list[dict]]):
    """A matplotlib figure of the curves of every network, by role."""
    from matplotlib.figure import Figure

    fig = Figure(figsize=(9.0, 3.0 * len(curves)), layout="constrained")
    axes = fig.subplots(len(curves), 2, squeeze=False)
    for (left, right), (role, rows) in zip(axes, curves.items(), strict=True):
        iteration = [row["iteration"] for row in rows]
        for key, style in (("train", "-"), ("validation", "--")):
            left.semilogy(iteration, [row[key] for row in rows], style, label=key, linewidth=1)
        left.set_title(f"{role}: normalised mean square error")
        left.set_xlabel("iteration")
        left.legend()
        right.plot(iteration, [row["gamma"] for row in rows], linewidth=1)
        right.set_title(f"{role}: effective parameters")
        right.set_xlabel("iteration")
        for axis in (left, right):
            axis.grid(True, alpha=0.3)
    return fig


def save(curves: dict[str, list[dict]], path: Path) -> None:
    """The figure as a PNG or SVG file, by its ending."""
    figure(curves).savefig(path, dpi=110)
