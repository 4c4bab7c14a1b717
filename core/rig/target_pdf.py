"""A printed target as a PDF: vectors, so that a printer draws edges as sharp as it can, and rulers to check the print with.

The same target gives the same bytes: there is no date in them, and nothing is compressed.
"""

from pathlib import Path

import numpy as np

from ..errors import StrandscopeError
from ..files import atomic
from .target import Target

PAGE_MM = (210.0, 297.0)  # A4; what is drawn fits on US letter too, if it is printed in the middle
ROOM_MM = (180.0, 110.0)  # there is for the board
BOARD_MM = (105.0, 205.0)  # where its middle is, from the lower left corner of the page
RULER_MM = 100.0
POINT_MM = 25.4 / 72


def print_target(out: Path, target: Target) -> None:
    """Write a target, at its true size, as a PDF. Raises StrandscopeError without OpenCV, and for one that does not fit on the page."""
    width, height = target.size_mm
    if width > ROOM_MM[0] or height > ROOM_MM[1]:
        raise StrandscopeError(
            f"{out}: a target of {width:g} x {height:g} mm does not fit on a page; expected {ROOM_MM[0]:g} x {ROOM_MM[1]:g} mm or less (--square-mm)"
        )
    with atomic(out) as part:
        part.write_bytes(_document(_drawing(target)))


def _drawing(target: Target) -> str:
    """The page in PDF's operators, in mm from the lower left corner."""
    width, height = target.size_mm
    left, bottom = BOARD_MM[0] - width / 2, BOARD_MM[1] - height / 2
    rectangles = target.black_mm() + np.array([*BOARD_MM, *BOARD_MM])
    lines = [f"{1 / POINT_MM:.9f} 0 0 {1 / POINT_MM:.9f} 0 0 cm", "0 g"]
    lines += [f"{x0:.4f} {y0:.4f} {x1 - x0:.4f} {y1 - y0:.4f} re" for x0, y0, x1, y1 in rectangles]
    lines += ["f", "0.1 w", *_ruler(42.0, 118.0, 1, 0), *_ruler(28.0, 28.0, 0, 1)]
    for x in (left, left + width):  # marks to cut along, outside a white margin
        for y, way in ((bottom, -1), (bottom + height, 1)):
            lines += [f"{x:.4f} {y + 5 * way:.4f} m {x:.4f} {y + 9 * way:.4f} l S"]
    size = f"{target.columns} x {target.rows} squares of {target.square_mm:.2f} mm: {width:.2f} mm wide, {height:.2f} mm high"
    texts = [
        (20, 270, 5.0, "Strandscope calibration target"),
        (20, 263, 3.5, f"{size}; markers {target.marker_mm:.2f} mm, {target.dictionary}"),
        (42, 109, 3.5, "100 mm"),
        (32, 122, 3.5, "100 mm"),
        (42, 96, 3.2, "Print at 100 % (actual size), not fitted to the page, 600 dpi or more, black and white, on matt paper."),
        (42, 90, 3.2, "Check both rulers with a steel ruler or calipers. If 100 mm are 99.8 mm, say so: --ruler-mm 99.8."),
        (42, 84, 3.2, "If the two rulers differ by more than 0.2 mm, use another printer."),
        (42, 78, 3.2, "Cut it out with a white margin of 4 mm, and glue it flat onto glass or a metal plate."),
        (42, 72, 3.2, "Mount it upright, its middle on the axis of the turntable to a millimetre or two."),
        (42, 66, 3.2, "Then: strandscope calibrate CAPTURE --target -o rig.json (docs/calibration.md)"),
    ]
    for x, y, points, text in texts:
        lines.append(f"BT /F1 {points:g} Tf 1 0 0 1 {x:g} {y:g} Tm ({_escaped(text)}) Tj ET")
    return "\n".join(lines) + "\n"


def _ruler(x: float, y: float, right: int, up: int) -> list[str]:
    """A ruler of 100 mm from (x, y), to the right or up, with a tick each mm."""
    lines = [f"{x:.4f} {y:.4f} m {x + RULER_MM * right:.4f} {y + RULER_MM * up:.4f} l S"]
    for i in range(int(RULER_MM) + 1):
        long = 5.0 if i % 10 == 0 else 3.5 if i % 5 == 0 else 2.0
        at_x, at_y = x + i * right, y + i * up
        lines.append(f"{at_x:.4f} {at_y:.4f} m {at_x - long * up:.4f} {at_y + long * right:.4f} l S")
    return lines


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _document(drawing: str) -> bytes:
    """A PDF of one page (ISO 32000-1, 7.5)."""
    width, height = (mm / POINT_MM for mm in PAGE_MM)
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R /Resources << /Font << /F1 5 0 R >> >> >>",
        f"<< /Length {len(drawing)} >>\nstream\n{drawing}endstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    text, places = "%PDF-1.4\n", []
    for number, content in enumerate(objects, 1):
        places.append(len(text))
        text += f"{number} 0 obj\n{content}\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    count = len(objects) + 1
    text += f"xref\n0 {count}\n0000000000 65535 f \n{table}trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{len(text)}\n%%EOF\n"
    return text.encode("ascii")
