"""What a printed target told of a rig, for people: each number with its meaning, and which screw to turn."""

from dataclasses import dataclass

import numpy as np

from .calibrate import SURE
from .target_calibrate import TargetCalibration


@dataclass(frozen=True)
class Alignment:
    """How far a rig may be off the paper's alignments before someone should turn a screw. What is less is corrected by numbers."""

    axis_mm: float = 2.0  # from the middle of the image
    tilt_deg: float = 0.5  # of the axis, in the image and towards the camera
    travel_deg: float = 0.5  # between the stage and the line of sight
    focus_mm: float = 1.0
    scale_parts: float = 0.03  # of the working distance and of the pitch
    distortion_px: float = 8.0  # at the corner of the image
    bowl_mm: float = 0.6
    turn_deg: float = 0.05
    left_px: float = 0.3


def warnings(found: TargetCalibration, allowed: Alignment | None = None) -> list[str]:
    """What should be set right on the rig itself, and which screw does it; empty for one that is well aligned."""
    allowed, optics, stated, known = allowed or Alignment(), found.optics, found.stated, found.uncertain
    off_mm = (optics.axis_col_px - found.middle_px[0]) * optics.pitch_mm
    tilt, towards, travel, up = optics.tilt_deg, optics.tilt_towards_deg, optics.travel_deg, optics.travel_up_deg
    focus, rim, bowl = found.errors.focus_mm, found.distortion_px[0], found.bowl_mm[0]
    distance, pitch = optics.working_distance_mm / stated.working_distance_mm - 1, optics.pitch_mm / stated.pitch_mm - 1
    checks = [  # (value, its standard error, how much is allowed, what it is, what to do)
        (off_mm, known.axis_px * optics.pitch_mm, allowed.axis_mm,
         f"the axis is {abs(off_mm):.1f} mm {_of(off_mm, 'right', 'left')} of the middle of the image",
         f"move the turntable to the {_of(off_mm, 'left', 'right')} by that, or the camera to the {_of(off_mm, 'right', 'left')}"),
        (tilt, known.tilt_deg, allowed.tilt_deg,
         f"the axis leans {abs(tilt):.2f}° to the {_of(tilt, 'right', 'left')} in the image",
         f"loosen the lens collar and turn the camera {_of(tilt, 'clockwise', 'counterclockwise')} by that (from behind), or level the turntable"),
        (towards, known.tilt_towards_deg, allowed.tilt_deg,
         f"the camera looks {abs(towards):.2f}° {_of(towards, 'down', 'up')} at the axis",
         f"point the lens {_of(towards, 'up', 'down')} by that at the screw under the camera's plate, or level the turntable"),
        (travel, known.travel_deg, allowed.travel_deg,
         f"the stage leads the camera {abs(travel):.2f}° to the {_of(travel, 'right', 'left')} of its line of sight as it draws back",
         f"loosen the camera's screw on the stage and turn the lens to the {_of(travel, 'left', 'right')} by that"),
        (up, known.travel_up_deg, allowed.travel_deg,
         f"the stage leads the camera {abs(up):.2f}° {_of(up, 'up', 'down')} as it draws back",
         f"tip the lens {_of(up, 'down', 'up')} by that with a shim under the camera's plate, or level the stage"),
        (focus, known.focus_mm, allowed.focus_mm,
         f"the plane of focus is {abs(focus):.2f} mm {_of(focus, 'nearer to', 'farther from')} the camera than the stage says",
         "set the stage's zero anew by that, or turn the focus ring back, and tape it"),
        (distance, known.working_distance_mm / stated.working_distance_mm, allowed.scale_parts,
         f"the working distance is {optics.working_distance_mm:.0f} mm, stated as {stated.working_distance_mm:.0f} mm",
         "correct what is stated, or turn the focus ring, and tape it"),
        (pitch, found.pitch_mm[1] / stated.pitch_mm, allowed.scale_parts,
         f"a millimetre is {1 / optics.pitch_mm:.2f} px wide, stated as {1 / stated.pitch_mm:.2f} px",
         "correct what is stated, or turn the focus ring, and set the stage's zero anew"),
        (rim, found.distortion_px[1], allowed.distortion_px,
         f"the lens distorts by {abs(rim):.1f} px at the corner of the image",
         "it is corrected; but look whether the lens is the one you think, since a macro lens does better"),
        (bowl, found.bowl_mm[1], allowed.bowl_mm,
         f"the corners of the image are in focus {abs(bowl):.2f} mm {_of(bowl, 'before', 'behind')} its middle, which is not corrected",
         "keep the hair in the middle of the image"),
        *((turned, error, allowed.turn_deg, f"at {angle:g}° the turntable is turned {turned:+.3f}° too far",
           "check its degrees a step, its belt, and that it always arrives from the same side") for angle, turned, error in found.turns_deg),
        (found.left_px, 0.0, allowed.left_px,
         f"corners lie {found.left_px:.2f} px off a flat board seen by such a rig",
         "glue the print flat onto glass, and let the stage come to rest before each photograph"),
    ]  # fmt: skip
    return [f"{what}: {do}" for value, error, most, what, do in checks if abs(value) > max(most, SURE * error)]


def _of(value: float, positive: str, negative: str) -> str:
    return positive if value > 0 else negative


def describe(found: TargetCalibration) -> list[tuple[str, str] | None]:
    """Rows (name, value with its error and meaning) for people; an error that is not sure is said to be none."""
    errors, known, pitch, board = found.errors, found.uncertain, found.optics.pitch_mm, found.board
    wider = (100 * (pitch / found.stated.pitch_mm - 1), 100 * found.pitch_mm[1] / pitch)
    turned = np.array(found.turns_deg)

    def row(name, value, error, form, unit, meaning):
        sure = "" if abs(value) >= SURE * error else "; none that is sure"
        return name, f"{value:+{form}} ± {error:{form}} {unit}  {meaning}{sure}"

    return [
        row("axis", errors.axis_px, known.axis_px, ".3f", "px", f"to the right, {errors.axis_px * pitch:+.4f} mm"),
        row("tilt", errors.tilt_deg, known.tilt_deg, ".4f", "°", "its upper end to the right"),
        row("tilt towards", errors.tilt_towards_deg, known.tilt_towards_deg, ".4f", "°", "its upper end towards the camera"),
        row("focus", errors.focus_mm, known.focus_mm, ".4f", "mm", "towards the camera"),
        row("working distance", errors.working_distance_mm, known.working_distance_mm, ".2f", "mm", "farther from the lens"),
        row("pitch", *wider, ".4f", "%", f"wider: {1 / pitch:.4f} px a mm"),
        row("travel", errors.travel_deg, known.travel_deg, ".4f", "°", "the stage leads to the right as it draws back"),
        row("travel up", errors.travel_up_deg, known.travel_up_deg, ".4f", "°", "and upwards"),
        row("distortion", *found.distortion_px, ".2f", "px", "outwards at the corner of the image"),
        row("bowl", *found.bowl_mm, ".3f", "mm", "by which the corner of the image is in focus nearer to the camera; not corrected"),
        ("turntable", f"{turned[:, 1].min():+.4f} … {turned[:, 1].max():+.4f} °, each ± {np.median(turned[:, 2]):.4f}"),
        None,
        ("board", f"{board['right_mm']:+.2f} mm right of the axis, {board['before_mm']:+.2f} mm before it, turned {board['facing_deg']:+.2f}°, "
         f"{board['lean_deg']:+.2f}° back, rolled {board['roll_deg']:+.2f}°"),
        ("left over", f"{found.left_px:.3f} px ({1000 * found.left_px * pitch:.1f} µm) in the image, {1000 * found.left_mm:.0f} µm in depth"),
        ("seen", f"{found.corners} times a corner, in {found.photographs} photographs"),
    ]  # fmt: skip
