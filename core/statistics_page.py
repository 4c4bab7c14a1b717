"""The statistics on one page: what was captured, the infill, and other hair, drawn over each other."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from .errors import StrandscopeError
from .figures import DPI, FAINT, STYLE
from .files import atomic
from .statistics import ALL_NAME, BESIDE_NAME, CAPTURED_NAME, CLUMP_CLASSES, INFILL_NAME

LOOKS = {  # told apart without colour, too: by brightness and by dashes
    CAPTURED_NAME: {"color": "#56b4e9", "linestyle": "-"},
    INFILL_NAME: {"color": "#f0a030", "linestyle": "-"},
    ALL_NAME: {"color": "#ffffff", "linestyle": (0, (1, 1.4))},
    BESIDE_NAME: {"color": "#e58ac8", "linestyle": (0, (5, 1.6))},
}
WIDTH, THIN = 1.5, 0.7
FLAT = 1e-12  # power of a spectrum, below which it is that of rounding


def plot(report: dict, path: Path, beside: str | None = None) -> None:
    """Draw the report of ``statistics.side_by_side`` as a PNG; beside: what the other hair is called."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sets = report["sets"]
    if not sets:
        raise StrandscopeError(f"{path}: there is nothing to draw; no curve lies in the region")
    with rc_context(STYLE | {"axes.facecolor": "#101010", "axes.titlepad": 7}):
        figure = Figure((11.0, 12.2), dpi=DPI, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.12, hspace=0.03)
        for axes, draw in zip(figure.subplots(4, 3).ravel(), PANELS, strict=True):
            draw(axes, sets, report["parameters"])
            axes.tick_params(length=2.5, labelsize=8)
            axes.spines[["top", "right"]].set_visible(False)
        _legend(figure, sets, beside)
        with atomic(path) as part:
            FigureCanvasAgg(figure).print_png(part)


def _legend(figure, sets, beside):
    from matplotlib.lines import Line2D

    handles = []
    for name, numbers in sets.items():
        away, title = numbers["flyaways"]["share_of_curves"], (beside or name) if name == BESIDE_NAME else name
        told = f"{title}\n{numbers['curves']} curves, {numbers['length_mm'] / 1000:.2f} m" + (
            "" if away is None else f"\n{100 * away:.1f} % flyaways"
        )
        handles.append(Line2D([], [], linewidth=2.2, label=told, **LOOKS[name]))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=9, handlelength=2.4, columnspacing=3.5)


# ---- panels ----------------------------------------------------------------------------------------------------------


def _histogram(key, title, label, scale=1.0, line=None):
    """A panel: the distribution of a quantity as steps."""

    def draw(axes, sets, _):
        axes.set(title=title, xlabel=label, ylabel="share of length" if key != "density_per_mm2" else "share of squares", yticks=[])
        if line is not None:
            axes.axvline(line, color=FAINT, linewidth=THIN)
        for name, numbers in sets.items():
            if numbers[key]["samples"]:
                edges = scale * np.array(numbers[key]["edges"])
                axes.stairs(numbers[key]["share_per_unit"], edges, linewidth=WIDTH, **LOOKS[name])
                axes.plot(scale * numbers[key]["median"], 0, marker="^", color=LOOKS[name]["color"], markersize=6, clip_on=False, zorder=5)
        axes.set_ylim(bottom=0)
        axes.margins(x=0)

    return draw


def _heights(axes, sets, _):
    axes.set(title="Density along the hair", xlabel="height, mm", ylabel="fibers per mm²")
    for name, numbers in sets.items():
        told = numbers["planes"]
        area, count = np.array(told["area_mm2"]), np.array(told["crossings"], float)
        axes.plot(told["heights_mm"], np.where(area > 0, count / np.where(area > 0, area, 1), np.nan), linewidth=WIDTH, **LOOKS[name])
    axes.set_ylim(bottom=0)
    axes.margins(x=0)


def _correlation(axes, sets, _):
    axes.set(title="Pair correlation across the hair", xlabel="distance, mm", ylabel="g")
    axes.axhline(1, color=FAINT, linewidth=THIN)
    for name, numbers in sets.items():
        told = numbers["pair_correlation"]
        axes.plot(told["distance_mm"], _floats(told["g"]), linewidth=WIDTH, **LOOKS[name])
    axes.set_ylim(0, min(axes.get_ylim()[1], 4))
    axes.set_xlim(left=0)


def _parallelism(axes, sets, _):
    axes.set(title="Angle between neighbours", xlabel="distance, mm", ylabel="median and quartiles, °")
    for name, numbers in sets.items():
        told = numbers["parallelism"]
        if name != ALL_NAME:
            low, high = _floats(told["p25_deg"]), _floats(told["p75_deg"])
            axes.fill_between(told["distance_mm"], low, high, color=LOOKS[name]["color"], alpha=0.16, linewidth=0)
        axes.plot(told["distance_mm"], _floats(told["median_deg"]), linewidth=WIDTH, **LOOKS[name])
    axes.set_ylim(bottom=0)
    axes.set_xlim(left=0)


def _spectrum(key, title, label):
    def draw(axes, sets, _):
        from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

        axes.set(title=title, xlabel="wavelength, mm", ylabel=label)
        told = {name: numbers["spectra"][key] for name, numbers in sets.items()}
        power = {name: _floats(one["power"]) for name, one in told.items() if one["segments"]}
        most = max((values.max(initial=0.0) for values in power.values()), default=0.0)
        if most < FLAT:  # nothing bends, or no curve is long enough
            axes.set(xticks=[], yticks=[])
            axes.text(0.5, 0.5, "no waves" if power else "no curve is long enough", color=FAINT, ha="center", transform=axes.transAxes)
            return
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        for name, values in power.items():
            axes.plot(told[name]["wavelength_mm"], np.where(values > 1e-6 * most, values, np.nan), linewidth=WIDTH, **LOOKS[name])
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        low, high = axes.get_ylim()
        axes.yaxis.set_major_locator(LogLocator(10, (1, 2, 3, 5, 7) if high < 8 * low else (1, 2, 5) if high < 50 * low else (1,)))
        axes.margins(x=0)

    return draw


def _clumps(axes, sets, _):
    upper = [f"{low}" if high == low + 1 else f"{low}–{high - 1}" for low, high in pairwise(CLUMP_CLASSES)]
    axes.set(title="Size of the clump of a fiber", xlabel="fibers in the clump; 1 is on its own", ylabel="share of fibers, %")
    axes.set_xticks(range(len(CLUMP_CLASSES)), [*upper, f"{CLUMP_CLASSES[-1]}+"])
    wide = 0.82 / len(sets)
    for k, (name, numbers) in enumerate(sets.items()):
        place = np.arange(len(CLUMP_CLASSES)) + (k - 0.5 * (len(sets) - 1)) * wide
        axes.bar(place, 100 * np.array(numbers["clumps"]["share"]), 0.9 * wide, color=LOOKS[name]["color"])


def _floats(values):
    return np.array([np.nan if value is None else value for value in values], float)


PANELS = (
    _histogram("density_per_mm2", "Density in squares of a plane", "fibers per mm²"),
    _heights,
    _correlation,
    _histogram("nearest_mm", "Nearest neighbour", "distance of the centrelines, mm"),
    _histogram("nearest_radii", "Nearest neighbour, in widths", "distance in sums of the two radii", line=1.0),
    _parallelism,
    _histogram("curvature_per_mm", "Curvature", "1/mm"),
    _histogram("torsion_per_mm", "Torsion, right-handed > 0", "rad/mm", line=0.0),
    _histogram("radius_mm", "Radius", "µm", scale=1000.0),
    _spectrum("curvature", "Spectrum of the curvature", "power, 1/mm"),
    _spectrum("torsion", "Spectrum of the torsion", "power, rad²/mm"),
    _clumps,
)
