"""The whole flow: a capture's photographs -> ridges -> features -> fibers -> hull and infill -> strands.

What a run needs to go on after a crash lies in a folder beside the output, one finished file a sweep.
"""

import hashlib
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path

import numpy as np

from .advection import advect, captured_density
from .capture import Capture, Sweep, features_path, load_capture
from .cluster import Cluster, Hands, unheard
from .confidence import confidence, expected_error
from .crew import Threads
from .errors import CaptureError, StrandscopeError
from .features import RECORDS, Index, SweepFeatures, build_index, load_features, pack, save_features, seen_by, unpack, upright
from .files import atomic, toml_tables
from .geometry import Optics
from .grid import Grid
from .grow import Grown, GrowParams, grow
from .hull import HullParams, blueness, carve, free_share, grid_of, occupancy, visual_hull
from .infill import Captured, InfillParams, infill
from .inside import InsideParams, surface_distance
from .journal import Journal, Unwritten
from .match import Reach, sides_of, sightings
from .paper import PaperParams, grow_paper
from .progress import Progress, silent
from .radius import RadiusParams, measured
from .refine import RefineParams, trace
from .ridges import RidgeParams, Ridges, detect, estimate
from .rig.calibrate import (
    ANGLE_FLOOR_DEG,
    FIRST_SWEEP,
    SURE,
    TUKEY,
    Calibration,
    RigErrors,
    Solution,
    calibrated,
    drift,
    gains,
    light,
    load_errors,
    save_calibration,
    solve,
    turns,
)
from .strands import CAPTURED, INFILL, Strands, concatenate, load_strands, save_strands
from .volume import Volume, load_volume, save_volume, surface

VERSION = "0.1.0"
WORKING_ROOM = 600_000_000  # bytes: the program itself, seed cells, a batch of curves
SAMPLED_PHOTOGRAPHS = 24  # that ``estimate`` looks at
STAMP, JOURNAL, USED_UP, VOLUME = "made-from.txt", "growing.journal", "growing.used", "volume.npz"  # in the folder beside the output
# Table 1: c in 12-bit numbers with the black level (128) in it, omega in degrees, gamma in px, boxes in px
_TABLE_1 = {"straight": (-140, 1.5, 0.5, (40.0, 30.0, 8.0)), "wavy": (-90, 1.5, 0.5, (60.0, 30.0, 8.0)), "curls": (-70, 1.5, 0.5, (60.0, 30.0, 8.0))}


@dataclass(frozen=True)
class Parameters:
    """One frozen object a stage."""

    ridges: RidgeParams = field(default_factory=RidgeParams)
    grow: GrowParams = field(default_factory=GrowParams)
    refine: RefineParams = field(default_factory=RefineParams)
    radius: RadiusParams = field(default_factory=RadiusParams)
    paper: PaperParams | None = None  # not None: fibers are grown the paper's way, and ``grow`` and ``refine`` do not count
    hull: HullParams = field(default_factory=HullParams)
    inside: InsideParams = field(default_factory=InsideParams)
    infill: InfillParams | None = field(default_factory=InfillParams)  # None: captured fibers only


def preset(name: str = "auto", method: str = "strandscope") -> Parameters:
    """The parameters of a preset: "auto", or the hair of Table 1, "straight", "wavy", "curls".

    method "paper" is the paper's own operator and growing with Table 1's constants; else the cone, the bound of the
    correction and the boxes are Table 1's and all that depends on the camera's light is estimated.
    """
    c, omega, gamma, boxes = _TABLE_1["straight" if name == "auto" else name]
    bounds = {"cone_deg": omega, "max_correction_px": gamma, "box_px": boxes}
    if method == "paper":
        ridges = RidgeParams("paper", low=0.03, high=0.08, offset=(c + 128) / (4095 - 128))
        return Parameters(ridges=ridges, paper=replace(PaperParams(), **bounds), infill=InfillParams(method="paper"))
    return Parameters(grow=replace(GrowParams(), **bounds))


def reconstruct(
    capture_path: Path,
    out: Path,
    parameters: Parameters,
    *,
    calibration: Path | None = None,
    workers: int = 1,
    memory_bytes: int = 6 * 10**9,
    progress: Progress = silent,
    scheduler: str | None = None,
    tell: Callable[[str], None] = unheard,
) -> Strands:
    """Reconstruct a capture and write its strands to ``out`` (.npz); returns them.

    The errors of the rig that a ``calibration`` file tells are corrected. With the address of a Dask ``scheduler``, photographs and
    growing are done on its cluster, and ``workers`` do the rest here; ``tell`` is called with a line where that has to wait.

    The same capture and parameters give the same bytes for any number of workers, here or there, and after any interruption. Raises
    CaptureError for a capture that cannot be read, StrandscopeError where nothing was found or written, or more than ``memory_bytes``
    would be needed.
    """
    capture = load_capture(capture_path if scheduler is None else Path(capture_path).resolve())
    if calibration is not None:
        capture = calibrated(calibration, capture)
        if capture.features and scheduler is not None:
            raise StrandscopeError(
                f"{capture.folder}: has features in place of photographs, and workers of a cluster read these as they are; "
                "leave --scheduler away to have them corrected (--calibration)"
            )
    parameters = resolve(capture, parameters)
    capture = capture.reduced(parameters.ridges.reduce)
    work = work_folder(capture, Path(out), parameters)
    with ExitStack() as open_ones:
        cluster = open_ones.enter_context(Cluster(scheduler, [capture.folder], tell)) if scheduler else None
        sweeps = find_features(capture, work, parameters, workers, progress, cluster)
        _check_memory(sweeps, memory_bytes)
        journal = Unwritten()
        if parameters.paper is None:
            journal = open_ones.enter_context(Journal(_work_path(Path(out)) / JOURNAL, _grown_from(capture, parameters)))
        grown, error, radius = _grown(capture, work, Path(out), sweeps, parameters, workers, progress, cluster, journal)
        if len(grown.offsets) < 2:
            raise StrandscopeError(
                f"{capture.folder}: no fiber was found in {sum(map(len, sweeps))} features; expected hairs in focus in the photographs"
            )
        provenance = {"capture": capture.name, "version": VERSION, "parameters": asdict(parameters)}
        strands = captured_strands(grown, error, radius, provenance)
        if parameters.infill is not None:
            strands = infill_strands(capture, work, sweeps, strands, parameters, workers, progress, volume_path(out))
        save_strands(out, strands)
        journal.delete()
    return strands


def _grown(
    capture: Capture,
    work: Path,
    out: Path,
    sweeps: list[SweepFeatures],
    parameters: Parameters,
    workers: int,
    progress: Progress,
    cluster: Cluster | None,
    journal: Unwritten,
) -> tuple[Grown, np.ndarray | None, np.ndarray]:
    """The fibers in the features of all sweeps, the error to be expected of their points (N,), if it is known, and their radius (N,).
    The index, which is as large as the features, is gone when they are found."""
    index = build_index(sweeps, capture.optics)
    if parameters.paper is not None:
        grown = grow_paper(index, parameters.paper, progress)
        return grown, None, np.full(len(grown.points_mm), parameters.paper.radius_mm, np.float32)
    with _crew(index, capture, work, out, workers, cluster) as crew:
        grown = trace(index, parameters.grow, parameters.refine, workers, progress, crew, journal)
    error = expected_error(index, parameters.grow, parameters.refine, grown.points_mm, grown.offsets, grown.evidence, workers)
    radius = measured(index, sweeps, grown.points_mm, grown.offsets, parameters.grow, parameters.refine, parameters.radius, workers)
    return grown, error, radius


def _crew(index: Index, capture: Capture, work: Path, out: Path, workers: int, cluster: Cluster | None) -> Threads:
    """Who grows: threads of this process, or the workers of a cluster."""
    if cluster is None:
        return Threads(index, workers)
    features = [features_path(work, i) for i in range(len(capture.sweeps))]
    return Hands(cluster, index, workers, features, capture.optics, _work_path(out) / USED_UP)


# ---- photographs -> features -----------------------------------------------------------------------------------------


def find_features(
    capture: Capture, work: Path, parameters: Parameters, workers: int, progress: Progress, cluster: Cluster | None = None
) -> list[SweepFeatures]:
    """The features of every sweep, filtered from the photographs, here or on a cluster, unless ``work`` has them from a run before, or
    the capture itself; these are as a photograph shows them, and are set right for what is known of the rig."""
    missing = [i for i in range(len(capture.sweeps)) if not all(path(work, i).is_file() for path in _PRODUCTS)]
    shape, total = capture.shape, sum(len(capture.sweeps[i].files) for i in missing)
    jobs = (job for i in missing for job in _jobs(capture, i, parameters, shape))
    done = 0
    with _processes(workers) if cluster is None else nullcontext(cluster.map) as run:
        results = run(_filter, jobs)
        for i in missing:
            sweep, ridges, blues, lights = capture.sweeps[i], [], [], []
            for d in sweep.positions_mm:
                progress("finding ridges", done, total)
                found, blue, lit = next(results)
                ridges.append(upright(found, d, capture.optics, shape))
                blues.append(blue)
                lights.append(lit)
                done += 1
            for path, pictures in ((blueness_path, blues), (light_path, lights)):
                with atomic(path(work, i)) as part:
                    np.save(part, np.stack(pictures))
            save_features(features_path(work, i), pack(sweep.angle_deg, sweep.positions_mm, shape, ridges))
    progress("finding ridges", total, total)
    found = [load_features(features_path(work, i)) for i in range(len(capture.sweeps))]
    if not capture.features:
        return found
    return [f if _as_stored(f, s, capture.optics) else seen_by(f, s, capture.optics) for f, s in zip(found, capture.sweeps, strict=True)]


def _as_stored(features: SweepFeatures, sweep: Sweep, optics: Optics) -> bool:
    """Whether nothing is known of the rig that the stored features of a sweep do not have already."""
    same = np.allclose(np.sort(sweep.positions_mm), features.positions_mm, rtol=0, atol=1e-6) and abs(sweep.angle_deg - features.angle_deg) < 1e-9
    return same and optics == optics.ideal()


def _jobs(capture: Capture, i: int, parameters: Parameters, shape: tuple[int, int]) -> Iterator[tuple]:
    """What there is to do for the photographs of sweep i; of the capture, no more than is needed is sent along."""
    capture = replace(capture, sweeps=(capture.sweeps[0], capture.sweeps[i]))
    for file in capture.sweeps[1].files:
        yield capture, file, parameters, shape


def _filter(job: tuple[Capture, str, Parameters, tuple[int, int]]) -> tuple[Ridges, np.ndarray, np.ndarray]:
    """One photograph: its ridges on the red plane, its picture of blueness and its picture of light."""
    capture, file, parameters, shape = job
    planes = capture.planes(file, "RGB")
    if planes.shape[1:] != shape:
        found, first = (f"{2 * s[1]} x {2 * s[0]}" for s in (planes.shape[1:], shape))
        raise CaptureError(f"{capture.folder / file}: the photograph has {found} pixels; expected {first}, as {capture.sweeps[0].files[0]}")
    return detect(planes[0], parameters.ridges), blueness(planes, parameters.hull), light(planes)


@contextmanager
def _processes(workers: int) -> Iterator:
    """An ordered ``map`` over ``workers`` processes; this one alone for a single worker. Leaving it early cancels the rest."""
    if workers == 1:
        yield map
        return
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=end_with_parent)
    try:
        yield lambda function, jobs: pool.map(function, jobs, chunksize=4)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def end_with_parent() -> None:
    """A worker whose parent was killed must not live on."""

    def wait():
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _check_memory(sweeps: list[SweepFeatures], memory_bytes: int) -> None:
    """Raise StrandscopeError where the features alone, 8 bytes each and 4 a cell, and room to work, do not fit."""
    needed = sum(8 * len(s) + 4 * len(s.cells) for s in sweeps) + WORKING_ROOM
    if needed > memory_bytes:
        told, allowed = (f"{n / 1e9:.1f} GB" for n in (needed, memory_bytes))
        raise StrandscopeError(f"{sum(map(len, sweeps))} features need about {told} of memory; {allowed} are allowed (--memory), give more")


def blueness_path(work: Path, i: int) -> Path:
    """Where a work folder has the pictures of blueness of sweep i."""
    return work / f"sweep_{i:03d}.blueness.npy"


def light_path(work: Path, i: int) -> Path:
    """Where a work folder has the pictures of light of sweep i."""
    return work / f"sweep_{i:03d}.light.npy"


_PRODUCTS = (features_path, blueness_path, light_path)  # of the filter, a file each for every sweep


def resolve(capture: Capture, parameters: Parameters) -> Parameters:
    """Fill in what the parameters leave to be estimated from the photographs."""
    if capture.features:
        return replace(parameters, ridges=replace(parameters.ridges, offset=0.0, reduce=1))
    if parameters.ridges.offset is not None:
        return replace(parameters, ridges=replace(parameters.ridges, reduce=parameters.ridges.reduce or 1))
    photographs = [(sweep, file) for sweep in capture.sweeps for file in sweep.files]
    chosen = [photographs[i] for i in np.linspace(0, len(photographs) - 1, SAMPLED_PHOTOGRAPHS + 2).astype(int)[1:-1]]
    return replace(parameters, ridges=estimate([capture.planes(file)[0] for _, file in chosen], parameters.ridges))


def work_folder(capture: Capture, out: Path, parameters: Parameters) -> Path:
    """The folder beside ``out`` for this capture and these parameters of the filter; emptied when they were others. That of the capture
    itself where it comes with features."""
    if capture.features:
        return capture.folder / capture.features
    digest, work = _made_from(capture, parameters), _work_path(out)
    stamp = work / STAMP
    if not stamp.is_file() or stamp.read_text() != digest:
        for old in work.glob("sweep_*"):
            old.unlink()
        with atomic(stamp) as part:
            part.write_text(digest)
    return work


def has_work_folder(capture: Capture, out: Path, parameters: Parameters) -> bool:
    """Whether a run of this capture with these parameters of the filter left its folder beside ``out``."""
    if capture.features:
        return True
    stamp = _work_path(out) / STAMP
    return stamp.is_file() and stamp.read_text() == _made_from(capture, parameters)


def _work_path(out: Path) -> Path:
    return out.with_name(out.stem + ".work")


def _grown_from(capture: Capture, parameters: Parameters) -> str:
    """A digest of all that grown curves depend on."""
    own = [os.stat(features_path(capture.folder / capture.features, i)) for i in range(len(capture.sweeps))] if capture.features else []
    told = {
        "features": None if capture.features else _made_from(capture, parameters),
        "files": [[stat.st_size, stat.st_mtime_ns] for stat in own],
        "version": VERSION,
        "optics": asdict(capture.optics),
        "sweeps": [asdict(sweep) for sweep in capture.sweeps],
        "grow": asdict(parameters.grow),
        "refine": asdict(parameters.refine),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _made_from(capture: Capture, parameters: Parameters) -> str:
    """A digest of all that features depend on."""
    stats = [(f, os.stat(capture.folder / f)) for s in capture.sweeps for f in s.files]
    told = {
        "version": VERSION,
        "records": RECORDS,
        "optics": asdict(capture.optics),
        "sweeps": [asdict(sweep) for sweep in capture.sweeps],
        "files": [[name, stat.st_size, stat.st_mtime_ns] for name, stat in stats],
        "ridges": asdict(parameters.ridges),
        "hull": [parameters.hull.block_px, parameters.hull.dark],
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


# ---- features -> what is wrong with the rig --------------------------------------------------------------------------

SPACING_MM, MOST_POINTS = 0.3, 12_000  # of points on curves that the rig is told from
CHORD_MM = 0.4  # half of what a direction is measured over
# pixels that a sweep's observations may lie off a curve, in each round, and the rounds that grow the curves anew
ROUNDS_PX = (6.0, 4.0, 3.0, 2.0, 1.5, 1.5, 1.5, 1.5)
GROWN_IN = (0, 2, 4)
LEAST_DRIFT = 0.003  # parts of the light, below which a drift is not corrected
BIAS_LEFT = 0.2  # share of what the biases of depth from focus explain that may be explained wrongly
# what is not explained by either, found on simulated locks with known rigs
FLOOR = RigErrors(axis_px=0.003, tilt_deg=0.001, tilt_towards_deg=0.005, focus_mm=0.004)
FLOOR_SCALE = 0.0003
TUKEY_FAR = 2.5  # in rounds where curves may lie far off: many observations are then those of other hairs
REGROW_PX = 0.25  # that the rig moved the hair since the curves were grown
SETTLED = 0.1  # a round that changes nothing by more than this many standard errors is the last


def calibrate(
    capture_path: Path,
    out: Path,
    parameters: Parameters,
    *,
    workers: int = 1,
    memory_bytes: int = 6 * 10**9,
    progress: Progress = silent,
    scheduler: str | None = None,
    tell: Callable[[str], None] = unheard,
    start: Path | None = None,
) -> Calibration:
    """Find the errors of the rig that took a capture from the capture itself, write them to ``out`` (.json, .toml); returns them.

    The photographs are filtered once, on a cluster if there is a ``scheduler``; then curves are grown with the rig as known so far,
    the rig is solved for, and so on until it stays. What a calibration file ``start`` tells, as from a printed target, is where that begins;
    what hair does not tell is kept as it has it. Raises CaptureError, StrandscopeError as ``reconstruct`` does, and where too few
    fibers are seen.
    """
    capture = load_capture(capture_path if scheduler is None else Path(capture_path).resolve())
    parameters = resolve(capture, replace(parameters, ridges=replace(parameters.ridges, reduce=1)))  # errors are told in whole pixels
    begun = RigErrors()
    if start is not None:
        calibrated(start, capture)  # raises where it is for another rig
        begun = load_errors(start)
    stated = replace(capture, optics=capture.optics.ideal())  # features as the photographs show them
    work = work_folder(stated, Path(out), parameters)
    with Cluster(scheduler, [capture.folder], tell) if scheduler else nullcontext() as cluster:
        sweeps = find_features(stated, work, parameters, workers, progress, cluster)
    _check_memory(sweeps, 2 * memory_bytes // 3)  # some are turned and joined anew in each round
    errors, solution, biased = _solved(capture, sweeps, parameters, workers, progress, begun)
    told = [gains(np.load(light_path(work, i))) for i in range(len(sweeps))]
    calibration = _summed_up(capture, errors, solution, biased, told)
    save_calibration(out, calibration)
    return calibration


def _solved(
    capture: Capture, sweeps: list[SweepFeatures], parameters: Parameters, workers: int, progress: Progress, begun: RigErrors
) -> tuple[RigErrors, Solution, np.ndarray]:
    """The errors of the rig by which the sweeps' features agree best, the last step towards them, and how far off each of its
    unknowns may be because the biases of depth from focus are not wholly those that the equations have."""
    errors, moved_px = begun, np.inf
    for number, reach_px in enumerate(ROUNDS_PX):

        def growing(_stage, done, total, number=number):
            progress("calibrating", number + 0.9 * done / total, len(ROUNDS_PX))

        growing("", 0, 1)
        rig = errors.corrected(capture)
        index = build_index([seen_by(f, s, rig.optics) for f, s in zip(sweeps, rig.sweeps, strict=True)], rig.optics)
        if number in GROWN_IN and moved_px > REGROW_PX:
            moved_px = 0.0
            points, tangents, bends = _on_curves(grow(index, parameters.grow, workers, growing))
        found = sightings(index, points, tangents, bends, _reach(reach_px, rig.optics, parameters), np.radians(rig.optics.tilt_towards_deg))
        last = reach_px == ROUNDS_PX[-1]
        solution = solve(found, len(sweeps), tukey=TUKEY if last else TUKEY_FAR)
        errors = errors.plus(solution.change, capture)
        half = np.array([1, 0.5 * index.rows * index.pitch, *[0.5 * index.columns * index.pitch] * len(sweeps)])  # mm: of the picture
        moved_px += np.abs(solution.change[[0, 1, *range(FIRST_SWEEP, len(solution.change))]] * half).max() / index.pitch
        moves = np.clip(solution.moves, -2 * reach_px * index.pitch, 2 * reach_px * index.pitch)
        points[solution.points] += np.einsum("ps,psi->pi", moves, sides_of(tangents[solution.points]))
        spread = np.sqrt(np.diag(solution.covariance))
        if last and np.all(np.abs(solution.change) <= SETTLED * spread):
            break
    progress("calibrating", len(ROUNDS_PX), len(ROUNDS_PX))
    unbiased = solve(found, len(sweeps), biased=False)
    return errors, solution, BIAS_LEFT * np.abs(unbiased.change - solution.change)


def _reach(across_px: float, optics: Optics, parameters: Parameters) -> Reach:
    """Which observations tell of a point of a curve, when curves may lie ``across_px`` off."""
    focus_mm = parameters.radius.usual_mm / np.tan(np.radians(optics.aperture_cone_deg) / 2)  # where the blur is as wide as a hair
    far = across_px > ROUNDS_PX[-1]
    return Reach(
        along_mm=0.2,
        across_mm=ROUNDS_PX[-1] * optics.pitch_mm,
        depth_mm=0.65 * focus_mm,
        first_across_mm=across_px * optics.pitch_mm,
        first_depth_mm=(1.3 if far else 0.65) * focus_mm,
        angle=float(np.radians(8.0)),
        least=8,
    )


def _on_curves(grown: Grown) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) mm on grown curves, evenly chosen, the unit tangents there, and the vectors of curvature (1/mm)."""
    points, offsets = grown.points_mm.astype(np.float64), grown.offsets
    if len(points) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    step_mm = float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    half = max(round(CHORD_MM / step_mm), 1)
    first, last = (np.repeat(ends, np.diff(offsets)) for ends in (offsets[:-1], offsets[1:] - 1))
    i = np.arange(len(points))
    inner = np.flatnonzero((i - first >= half) & (last - i >= half))  # ends of curves are the least sure
    stride = max(round(SPACING_MM / step_mm), -(-len(inner) // MOST_POINTS), 1)
    inner = inner[::stride]
    chord = points[inner + half] - points[inner - half]
    bends = (points[inner + half] + points[inner - half] - 2 * points[inner]) / (half * step_mm) ** 2
    return points[inner], chord / np.linalg.norm(chord, axis=1, keepdims=True), bends


def _summed_up(capture: Capture, errors: RigErrors, solution: Solution, biased: np.ndarray, told: list[tuple[np.ndarray, float]]) -> Calibration:
    """What was found, with uncertainties. The sweeps before the first step that slipped are right on average."""
    covariance = np.degrees(np.degrees(solution.covariance[FIRST_SWEEP:, FIRST_SWEEP:]))
    angles = np.array(errors.angles_deg)
    every, slips = turns(angles, covariance)
    right = slice(0, slips[0].sweep if slips else len(angles)) if every[0] == 0 else slice(0, 1)
    spread = np.hypot(np.sqrt(np.diag(solution.covariance)), biased)
    drifts = tuple((drift(gain), error) for gain, error in told)
    sure = any(np.isfinite(error) and abs(value) > max(SURE * error, LEAST_DRIFT) for value, error in drifts)
    known = RigErrors(
        axis_px=float(np.hypot(spread[0] / capture.optics.pitch_mm, FLOOR.axis_px)),
        tilt_deg=float(np.hypot(np.degrees(spread[1]), FLOOR.tilt_deg)),
        tilt_towards_deg=float(np.hypot(np.degrees(spread[2]), FLOOR.tilt_towards_deg)),
        focus_mm=float(np.hypot(spread[3], FLOOR.focus_mm)),
        working_distance_mm=float(capture.optics.working_distance_mm * np.hypot(spread[4], FLOOR_SCALE)),
        angles_deg=tuple(float(np.hypot(a, ANGLE_FLOOR_DEG)) for a in np.sqrt(np.diag(covariance))),
    )
    errors = replace(
        errors,
        angles_deg=tuple(float(a) for a in angles - angles[right].mean()),
        gains=tuple(tuple(float(g) for g in gain) for gain, _ in told) if sure else (),
    )
    return Calibration(capture.name, errors, known, every, tuple(slips), drifts, solution.across_mm, solution.depth_mm, len(solution.points))


# ---- fibers -> strands -----------------------------------------------------------------------------------------------


def captured_strands(grown: Grown, error_mm: np.ndarray | None, radius_mm: np.ndarray, provenance: dict) -> Strands:
    """The grown curves as strands, with the radius (N,) of their points. Confidence follows from the expected error (N,); where
    that is not known (None, the paper's method), it rises with the evidence for a point: 1 - exp(-evidence / 4)."""
    return Strands(
        points_mm=grown.points_mm,
        offsets=grown.offsets,
        radius_mm=radius_mm,
        kind=np.full(len(grown.offsets) - 1, CAPTURED, np.uint8),
        confidence=(1 - np.exp(grown.evidence / -4.0) if error_mm is None else confidence(error_mm)).astype(np.float32),
        stops=grown.stops,
        error_mm=error_mm,
        evidence=grown.evidence.astype(np.float32),
        provenance=provenance,
    )


def infill_strands(
    capture: Capture,
    work: Path,
    sweeps: list[SweepFeatures],
    strands: Strands,
    parameters: Parameters,
    workers: int,
    progress: Progress,
    kept: Path | None = None,
) -> Strands:
    """The captured ``strands`` and hair for the inside that no camera sees (sec. 4.3). Where that is, is written to the file ``kept``, if one
    is given, except for the paper's method."""
    params = parameters.infill
    if params.method == "paper":
        grid, hull, rays = volumes(capture, work, sweeps, parameters.hull, workers, progress)
        advection = replace(params.advection, count=params.count, seed=params.seed)
        bounds = occupancy(hull, rays, grid, parameters.hull)
        with _threads(workers):
            filled = advect(strands.points_mm, strands.offsets, strands.radius_mm, bounds, grid, advection, progress)
        joins = None
    else:
        volume = make_volume(capture, work, sweeps, strands, parameters, workers, progress)
        if kept is not None:
            save_volume(kept, volume)
        angles = np.array([sweep.angle_deg for sweep in capture.sweeps])
        through = free_share(volume.rays, volume.distance_mm < -parameters.inside.about_mm / 2)
        with _threads(workers):
            filled = infill(_told(strands), volume.distance_mm, through, volume.grid, angles, params, progress)
        joins = filled.joins
    count = len(filled.offsets) - 1
    added = Strands(
        points_mm=filled.points_mm,
        offsets=filled.offsets,
        radius_mm=filled.radius_mm,
        kind=np.full(count, INFILL, np.uint8),
        confidence=np.zeros(len(filled.points_mm), np.float32),
        stops=np.zeros((count, 2), np.uint8),
    )
    return replace(concatenate([strands, added], strands.provenance), joins=joins)


def inside(strands: Strands, bounds: np.ndarray, grid: Grid, angles_deg, params: InsideParams) -> np.ndarray:
    """Signed distance (nx, ny, nz) mm to the surface of the hair, by the captured strands and the bounding volume."""
    points, offsets = strands.points_mm.astype(np.float64), strands.offsets
    diameter = 2 * float(strands.radius_mm.mean())
    return surface_distance(points, captured_density(points, offsets, grid), bounds, diameter, grid, angles_deg, params)


def _told(strands: Strands) -> Captured:
    """What the infill is told of captured strands."""
    count = len(strands.points_mm)
    error = np.full(count, np.nan) if strands.error_mm is None else strands.error_mm
    evidence = np.zeros(count) if strands.evidence is None else strands.evidence
    stops = np.zeros((len(strands), 2), np.uint8) if strands.stops is None else strands.stops
    return Captured(strands.points_mm, strands.offsets, strands.radius_mm, error, evidence, stops)


def make_volume(
    capture: Capture, work: Path, sweeps: list[SweepFeatures], strands: Strands, parameters: Parameters, workers: int, progress: Progress
) -> Volume:
    """Where the hair is, by the cameras and the captured ``strands`` together."""
    grid, hull, rays = volumes(capture, work, sweeps, parameters.hull, workers, progress)
    angles = np.array([sweep.angle_deg for sweep in capture.sweeps])
    with _threads(workers):
        distance = inside(strands, occupancy(hull, rays, grid, parameters.hull), grid, angles, parameters.inside)
    return Volume(grid, hull, rays, distance, parameters.inside.edge_mm, *surface(distance, grid), _volume_from(strands, parameters))


def find_volume(capture_path: Path, strands_path: Path, *, calibration: Path | None = None, workers: int = 1, progress: Progress = silent) -> Volume:
    """Where the hair is that a capture and the ``strands_path`` made of it tell: as the reconstruction kept it beside the strands, or found
    now, and kept there (``volume_path``).

    calibration: the file that the strands were made with. Raises CaptureError and StrandscopeError for what cannot be read or written, and
    for strands without a captured curve.
    """
    strands = load_strands(strands_path).captured
    if len(strands) == 0:
        raise StrandscopeError(f"{strands_path}: holds no captured curve; expected one at least, to tell where hair is")
    parameters = made_with(strands)
    if (volume := kept_volume(strands_path, strands, parameters)) is not None:
        return volume
    capture = load_capture(capture_path)
    if calibration is not None:
        capture = calibrated(calibration, capture)
    parameters = resolve(capture, parameters)
    capture = capture.reduced(parameters.ridges.reduce)
    own = Path(strands_path)
    if not has_work_folder(capture, own, parameters):  # what another capture, or another calibration, left there is not touched
        own = own.with_name(own.stem + "_volume.npz")
    work = work_folder(capture, own, parameters)
    sweeps = find_features(capture, work, parameters, workers, progress)
    volume = make_volume(capture, work, sweeps, strands, parameters, workers, progress)
    save_volume(volume_path(strands_path), volume)
    return volume


def kept_volume(strands_path: Path, strands: Strands, parameters: Parameters) -> Volume | None:
    """The volume that was kept beside strands, if it is there, whole, and was made from their captured curves with these parameters."""
    path = volume_path(strands_path)
    try:
        volume = load_volume(path) if path.is_file() else None
    except StrandscopeError:  # it is made anew
        return None
    return volume if volume is not None and volume.made_from == _volume_from(strands.captured, parameters) else None


def volume_path(strands_path: Path) -> Path:
    """Where the volume of strands is kept: never in the capture."""
    return _work_path(Path(strands_path)) / VOLUME


def _volume_from(strands: Strands, parameters: Parameters) -> str:
    """A digest of the captured strands and of the parameters that a volume is made with."""
    told = json.dumps([VERSION, asdict(parameters.hull), asdict(parameters.inside)], sort_keys=True)
    digest = hashlib.sha256(told.encode())
    for values, dtype in ((strands.points_mm, np.float32), (strands.offsets, np.int64), (strands.radius_mm, np.float32)):
        digest.update(np.ascontiguousarray(values, dtype).tobytes())
    return digest.hexdigest()


def made_with(strands: Strands) -> Parameters:
    """The parameters of the filter, the hull and the occupancy that strands were made with, as far as their provenance tells, else the usual."""
    told = strands.provenance.get("parameters", {})
    try:
        parameters = replace(preset(), ridges=RidgeParams(**told["ridges"]), hull=HullParams(**told["hull"]))
        return replace(parameters, inside=InsideParams(**told.get("inside", {})))
    except (KeyError, TypeError):
        return preset()


def volumes(
    capture: Capture, work: Path, sweeps: list[SweepFeatures], params: HullParams, workers: int, progress: Progress
) -> tuple[Grid, np.ndarray, np.ndarray]:
    """The grid of the captured volume, the highest blueness and the number of rays at each of its voxels (Fig. 9)."""
    optics = capture.optics
    grid = grid_of(optics, capture.shape, capture.sweeps, params.voxel_mm)
    with _threads(workers):
        hull = visual_hull(_counted(_blue_stacks(capture, work), len(sweeps), "visual hull", progress), optics, grid, params)
        rays = carve(_counted(_rays(sweeps, capture), len(sweeps), "space carving", progress), optics, grid, params)
    return grid, hull, rays


def _blue_stacks(capture: Capture, work: Path) -> Iterator:
    for i, sweep in enumerate(capture.sweeps):
        yield sweep.angle_deg, sweep.positions_mm, np.load(blueness_path(work, i), mmap_mode="r")


def _rays(sweeps: list[SweepFeatures], capture: Capture) -> Iterator:
    for sweep in sweeps:
        yield sweep.angle_deg, *unpack(sweep, capture.optics)[:3]


def _counted(items: Iterator, total: int, stage: str, progress: Progress) -> Iterator:
    """The items, with progress told between them."""
    for i, item in enumerate(items):
        progress(stage, i, total)
        yield item
    progress(stage, total, total)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Let numba's parallel kernels use ``count`` threads, or as many as there are."""
    import numba

    before = numba.get_num_threads()
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        numba.set_num_threads(before)


# ---- parameters as TOML ----------------------------------------------------------------------------------------------


def write_toml(path: Path, parameters: Parameters) -> None:
    """Write parameters as TOML, a table a stage; what is to be estimated is left out, and ``infill = false`` is no infill."""
    import tomli_w

    tables = _without_none(asdict(parameters))
    if parameters.infill is None:
        tables = {"infill": False} | tables
    with atomic(path) as part:
        part.write_text(tomli_w.dumps(tables), encoding="utf-8")


def read_toml(path: Path) -> Parameters:
    """Read parameters from TOML; what is not there has its default. Raises StrandscopeError naming file and field."""
    tables = toml_tables(path, "parameters")
    without = tables.get("infill") is False
    start = Parameters(paper=PaperParams()) if "paper" in tables else Parameters()
    parameters = _filled(start, {k: v for k, v in tables.items() if not (without and k == "infill")}, path, "")
    return replace(parameters, infill=None) if without else parameters


def _without_none(values: dict) -> dict:
    return {k: _without_none(v) if isinstance(v, dict) else v for k, v in values.items() if v is not None}


def _filled(record, values: dict, path: Path, where: str):
    """``record`` with the fields that ``values`` gives, checked by name and kind."""
    known = {f.name: getattr(record, f.name) for f in fields(record)}
    changes = {}
    for name, value in values.items():
        if name not in known:
            raise StrandscopeError(f"{path}: {where}{name} is not a parameter; expected one of {', '.join(known)}")
        old = known[name]
        if is_dataclass(old):
            changes[name] = _filled(old, value, path, f"{where}{name}.") if isinstance(value, dict) else _wrong(path, where + name, value, "a table")
        elif isinstance(old, tuple):
            good = isinstance(value, list) and len(value) == len(old) and all(_is_number(v) for v in value)
            changes[name] = tuple(map(float, value)) if good else _wrong(path, where + name, value, f"{len(old)} numbers")
        elif isinstance(old, str):
            changes[name] = value if isinstance(value, str) else _wrong(path, where + name, value, "str")
        else:
            changes[name] = value if _is_number(value) else _wrong(path, where + name, value, "a number")
    return replace(record, **changes)


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _wrong(path: Path, name: str, value, expected: str):
    raise StrandscopeError(f"{path}: {name} is {value!r}; expected {expected}")
