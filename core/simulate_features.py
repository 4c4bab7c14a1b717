"""Whole captures without photographs: the features that known hair would leave, for locks of a size whose photographs would take days.

Hair is grown and hides itself as in ``simulate.py``; what the filter would say of it is made up from what it says of photographs: a
hair is found in the photographs around its depth, the more of them the more of the aperture sees it, once in every row that it crosses
(or column, where it lies flat), with errors that neighbouring rows share. Runs of ridge that belong to nothing lie between.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numba import njit

from . import geometry
from .capture import Capture, features_path, load_capture, save_capture
from .features import RECORDS, pack, save_features
from .files import atomic
from .groom import Groom, groom
from .hull import HullParams
from .pipeline import blueness_path, light_path
from .progress import Progress, silent
from .ridges import Ridges
from .simulate import Samples, SimulateParams, begin, each_of, lock_params, plan, prepare, samples, seen_volume, visibility, write_truth

FOLDER = "features"  # in the capture
PAPER_FIBERS = 6500  # of a whole switch, as the paper fills it


@dataclass(frozen=True)
class ObserveParams:
    """What a filter finds of hair. Pixels are those of the channel plane."""

    rays: int = 8  # of the aperture, by which it is told what is hidden
    slab_mm: float = 8.0  # depths that are looked at together
    strength: float = 0.15  # of a ridge in focus that all of the aperture sees
    hidden: float = 1.5  # power of the share of the aperture that sees it, with which this falls
    least: float = 0.02  # strength of a ridge that is found
    focus_mm: float = 0.42  # sigma by which it falls from the plane of focus
    tint: float = 0.35  # of the logarithm of a fiber's strength
    error_px: tuple[float, float] = (0.12, 0.08)  # across the hair: shared by neighbouring rows, and alone
    error_deg: tuple[float, float] = (1.0, 0.8)
    shared_mm: float = 0.2  # length over which errors are shared
    spurious: float = 0.3  # features that belong to nothing that is in focus, a true one
    run_px: int = 12  # length of their runs
    board: float = 0.62  # relative blueness of the board
    hair: float = 0.2


def simulate_features(
    out: Path, params: SimulateParams, observe: ObserveParams | None = None, progress: Progress = silent, workers: int = 0
) -> Capture:
    """A capture in the folder ``out`` with its truth and with features in place of photographs. Returns it as it was read back.

    A run that was interrupted goes on where it stopped; ``workers`` threads (0: one a core) do not change a byte. Raises
    StrandscopeError as ``simulate`` does.
    """
    observe, out = observe or ObserveParams(), Path(out)
    if params.scale == "paper" and params.fibers is None:
        params = replace(params, fibers=PAPER_FIBERS)
    asked = {"features": [asdict(observe), *RECORDS]}
    capture = replace(plan(out, params), features=FOLDER, turntable=None)
    if begin(out, params, asked):
        return load_capture(out)
    lock = _kept_groom(out / "groom.npz", params, progress)
    hair = prepare(lock, np.random.default_rng([params.seed, 1]))
    scale, rig = params.size, params.misalignment.errors(capture).corrected(capture)
    at = samples(lock, np.inf, scale.rows / 2 * params.pitch_mm + 1.0)
    seen = np.zeros((len(at.points_mm), len(capture.sweeps)), np.float16)
    shape = scale.rows, scale.columns

    def look(k):
        sweep = rig.sweeps[k]
        seen[:, k] = visibility(hair, at, rig.optics, sweep.angle_deg, observe.rays, observe.slab_mm, finer=1)
        if not features_path(out / FOLDER, k).is_file():
            rng = np.random.default_rng([params.seed, 3, k])
            ridges = _ridges(at, seen[:, k].astype(np.float32), sweep, rig.optics, shape, observe, rng)
            ridges = [_as_photographed(r, d, rig.optics, shape) for r, d in zip(ridges, sweep.positions_mm, strict=True)]
            found = pack(capture.sweeps[k].angle_deg, capture.sweeps[k].positions_mm, shape, ridges)
            _write_pictures(out / FOLDER, k, at, sweep, rig.optics, shape, observe)
            save_features(features_path(out / FOLDER, k), found)

    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        for done, _ in enumerate(each_of(pool, look, range(len(capture.sweeps)))):
            progress("features", done + 1, len(capture.sweeps))
    radius, half_height = seen_volume(params)
    inside = (np.hypot(at.points_mm[:, 0], at.points_mm[:, 2]) <= radius) & (np.abs(at.points_mm[:, 1]) <= half_height)
    write_truth(capture, lock, Samples(at.points_mm[inside], at.tangents[inside], at.strand[inside]), seen[inside])
    save_capture(replace(capture, unknown={"simulation": asdict(params) | asked}))
    (out / "groom.npz").unlink()
    return load_capture(out)


def _kept_groom(path: Path, params: SimulateParams, progress: Progress) -> Groom:
    """The lock, which takes minutes in large, from a run before or made now."""
    progress("groom", 0, 1)
    if not path.is_file():
        made = groom(replace(lock_params(params), overlap_mm=0.03), np.random.default_rng([params.seed, 0]))
        with atomic(path) as part:
            np.savez(part, **asdict(made))
    progress("groom", 1, 1)
    with np.load(path) as file:
        return Groom(**file)


def _ridges(at: Samples, seen, sweep, optics, shape, observe: ObserveParams, rng) -> list[Ridges]:
    """The ridges of each photograph of a sweep."""
    where = geometry.camera_points(at.points_mm, sweep.angle_deg, optics)
    follows = np.zeros(len(where), bool)  # a sample is joined with the next one
    follows[:-1] = (np.diff(at.strand) == 0) & (np.linalg.norm(np.diff(at.points_mm, axis=0), axis=1) < 0.2)
    tint = np.exp(observe.tint * rng.normal(size=at.strand.max() + 1 if len(at.strand) else 0))
    shared = _shared(rng.normal(size=(len(where), 2)), follows, np.exp(-0.1 / observe.shared_mm))
    errors = shared * (observe.error_px[0], np.radians(observe.error_deg[0]))
    strength = observe.strength * tint[at.strand] * seen**observe.hidden
    alone = observe.error_px[1], np.radians(observe.error_deg[1])
    view = optics.working_distance_mm, optics.pitch_mm, optics.axis_col_px, optics.axis_row_px
    told = where, follows, strength, errors, np.asarray(sweep.positions_mm), observe.least, observe.focus_mm, view, shape
    count = _crossings(*told, np.empty((0, 5), np.float32), np.empty(0, np.uint16))
    rows, frames = np.empty((count, 5), np.float32), np.empty(count, np.uint16)
    _crossings(*told, rows, frames)
    _blurred(rows, alone, rng)
    extra, extra_frames = _spurious(rows, frames, observe, rng)
    rows, frames = np.concatenate([rows, extra]), np.concatenate([frames, extra_frames])
    inside = (rows[:, 0] >= 0) & (rows[:, 0] <= shape[1] - 1) & (rows[:, 1] >= 0) & (rows[:, 1] <= shape[0] - 1)
    rows, frames = rows[inside], frames[inside]
    order = np.argsort(frames, kind="stable")
    rows, ends = rows[order], np.searchsorted(frames[order], np.arange(len(sweep.positions_mm) + 1))
    return [Ridges(*np.ascontiguousarray(rows[a:b].T)) for a, b in pairwise(ends)]


def _as_photographed(ridges: Ridges, focus_mm: float, optics: geometry.Optics, shape: tuple[int, int]) -> Ridges:
    """Ridges where a lens that distorts, on a stage that leads it aside, shows them; those that leave the photograph are dropped."""
    if not optics.displaces:
        return ridges
    col, row = (np.float32(a) for a in geometry.as_photographed(ridges.col, ridges.row, focus_mm, optics, shape))
    inside = (col >= 0) & (col <= shape[1] - 1) & (row >= 0) & (row <= shape[0] - 1)
    return Ridges(*(a[inside] for a in (col, row, ridges.angle, ridges.strength, ridges.breadth)))


def _blurred(rows: np.ndarray, alone: tuple[float, float], rng) -> None:
    """Give each ridge (n, 5) the errors of its own: across it, and of its angle."""
    off = rng.normal(0, alone[0], len(rows)).astype(np.float32)
    rows[:, 0] -= off * np.sin(rows[:, 2])
    rows[:, 1] -= off * np.cos(rows[:, 2])
    rows[:, 2] = (rows[:, 2] + rng.normal(0, alone[1], len(rows)).astype(np.float32)) % np.float32(np.pi)
    rows[:, 4] += rng.normal(0, 0.3, len(rows)).astype(np.float32)


def _spurious(rows: np.ndarray, frames: np.ndarray, observe: ObserveParams, rng) -> tuple[np.ndarray, np.ndarray]:
    """Short runs of weak ridge near hair, at an angle of their own: (n, 5) and the frames (n,)."""
    runs = int(observe.spurious * len(rows) / observe.run_px)
    if runs == 0:
        return rows[:0], frames[:0]
    near = rng.integers(0, len(rows), runs)
    start = rows[near, :2] + rng.normal(0, 12, (runs, 2)).astype(np.float32)
    angle = (rows[near, 2] + rng.normal(0, 0.35, runs)) % np.pi
    way = np.stack([np.cos(angle), -np.sin(angle)], axis=-1)[:, None] * np.arange(observe.run_px)[:, None]
    place = (start[:, None] + way).reshape(-1, 2)
    told = np.repeat(np.stack([angle, rng.uniform(1, 2, runs) * observe.least, np.zeros(runs)], axis=-1), observe.run_px, axis=0)
    return np.concatenate([place, told], axis=1).astype(np.float32), np.repeat(frames[near], observe.run_px)


@njit(cache=True, nogil=True)
def _shared(noise, follows, memory):
    """Noise (n, c) of which each sample that follows another keeps ``memory`` of it; its variance stays 1."""
    new = np.sqrt(1 - memory * memory)
    for i in range(1, len(noise)):
        if follows[i - 1]:
            for c in range(noise.shape[1]):
                noise[i, c] = memory * noise[i - 1, c] + new * noise[i, c]
    return noise


@njit(cache=True, nogil=True, error_model="numpy")
def _crossings(where, follows, strength, errors, positions, least, focus, view, shape, rows, frames):
    """Fill rows (n, 5) with column, row, angle, strength and breadth, and frames (n,), while there is room; returns how many there are.

    In each photograph in which a piece of hair is strong enough, it is found once in every row that it crosses.
    """
    distance, pitch, axis_col, axis_row = view
    count = 0
    for i in range(len(where)):
        peak = strength[i]
        if not follows[i] or peak < least:
            continue
        reach = focus * np.sqrt(2 * np.log(peak / least))
        w = 0.5 * (where[i, 2] + where[i + 1, 2])
        for frame in range(np.searchsorted(positions, w - reach), np.searchsorted(positions, w + reach)):
            d = positions[frame]
            here = peak * np.exp(-0.5 * ((w - d) / focus) ** 2)
            s0, s1 = distance / (distance + d - where[i, 2]), distance / (distance + d - where[i + 1, 2])
            c0, c1 = axis_col + where[i, 0] * s0 / pitch, axis_col + where[i + 1, 0] * s1 / pitch
            r0, r1 = axis_row - where[i, 1] * s0 / pitch, axis_row - where[i + 1, 1] * s1 / pitch
            if max(c0, c1) < 0 or min(c0, c1) > shape[1] - 1 or max(r0, r1) < 0 or min(r0, r1) > shape[0] - 1:
                continue
            steep = abs(r1 - r0) >= abs(c1 - c0)
            a, b = (r0, r1) if steep else (c0, c1)
            low, high = min(a, b), max(a, b)
            angle = np.arctan2(r0 - r1, c1 - c0)
            off_u, off_v = -np.sin(angle), -np.cos(angle)  # towards the normal, in columns and rows
            for line in range(int(np.ceil(low)), int(np.ceil(high))):
                t = (line - a) / (b - a)
                if count < len(rows):
                    across = errors[i, 0] + t * (errors[i + 1, 0] - errors[i, 0])
                    turned = errors[i, 1] + t * (errors[i + 1, 1] - errors[i, 1])
                    rows[count, 0] = c0 + t * (c1 - c0) + across * off_u
                    rows[count, 1] = r0 + t * (r1 - r0) + across * off_v
                    rows[count, 2] = (angle + turned) % np.pi
                    rows[count, 3], rows[count, 4] = here, 0.235
                    frames[count] = frame
                count += 1
    return count


def _write_pictures(folder: Path, k: int, at: Samples, sweep, optics, shape, observe: ObserveParams) -> None:
    """The pictures of blueness and light that the filter would leave: blue where no hair stands, in every photograph."""
    block, count = HullParams().block_px, len(sweep.positions_mm)
    where = geometry.camera_points(at.points_mm, sweep.angle_deg, optics)
    scale = optics.working_distance_mm / (optics.working_distance_mm - where[:, 2]) / optics.pitch_mm
    col, row = optics.axis_col_px + where[:, 0] * scale, optics.axis_row_px - where[:, 1] * scale
    hair = np.zeros((-(-shape[0] // block), -(-shape[1] // block)))
    inside = (col >= 0) & (col < shape[1]) & (row >= 0) & (row < shape[0])
    np.add.at(hair, ((row[inside] / block).astype(int), (col[inside] / block).astype(int)), 0.1 / optics.pitch_mm * 2.8 / block**2)
    covered = 1 - np.exp(-hair)  # parts of a block
    blue = np.uint8(255 * (covered * observe.hair + (1 - covered) * observe.board))
    for path, picture in ((blueness_path(folder, k), blue), (light_path(folder, k), np.ones((3, 1, 1), np.float32))):
        with atomic(path) as part:
            np.save(part, np.broadcast_to(picture, (count, *picture.shape)))
