"""Photographs and renderings of the same hair in one picture, brought to the same exposure."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .files import atomic

COVERED, EMPTY = 0.8, 0.01  # share of a pixel that the rendering covers: surely hair, surely background
ENOUGH_PX = 50
WHITE_PERCENTILE = 99.5  # of the photographs: this becomes white
GAP_PX, CAPTION_PX = 4, 24
PAPER, INK = (24, 24, 24), (220, 220, 220)


@dataclass(frozen=True)
class Exposure:
    """What turns a rendering into the light that the camera recorded, a channel each, and what is shown as white."""

    gain: np.ndarray  # (3,): of the rendering
    background: np.ndarray  # (3,): light of the board
    white: float

    def expose(self, rendering: np.ndarray) -> np.ndarray:
        """Linear planes (3, H, W) of a rendering (4, H, W): R, G, B with premultiplied alpha, over the background."""
        return self.gain[:, None, None] * rendering[:3] + self.background[:, None, None] * (1 - rendering[3])

    def develop(self, planes: np.ndarray) -> np.ndarray:
        """Linear planes (3, H, W) -> (H, W, 3) uint8 sRGB, as Blender's view transform "Standard" shows them."""
        light = np.clip(np.asarray(planes, np.float64) / self.white, 0, 1)
        shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        return (255 * np.moveaxis(shown, 0, -1) + 0.5).astype(np.uint8)


def match(photographs: list[np.ndarray], renderings: list[np.ndarray]) -> Exposure:
    """One exposure for all pairs of a photograph (3, H, W), linear, and a rendering (4, H, W) of the same view and size.

    The gain makes the median of the hair equal, a channel each: neither the light nor the colours of the camera are known
    here. The background is the median of the bluer half of what the rendering leaves empty.
    """
    photograph, rendering = (np.concatenate([p.reshape(len(p), -1) for p in planes], axis=1) for planes in (photographs, renderings))
    cover = rendering[3]
    hair = cover >= min(COVERED, np.sort(cover)[-min(ENOUGH_PX, len(cover))])
    gain = np.median(photograph[:, hair], axis=1) / np.maximum(np.median(rendering[:3, hair] / np.maximum(cover[hair], EMPTY), axis=1), 1e-6)
    empty = photograph[:, cover <= EMPTY]
    if empty.shape[1] < ENOUGH_PX:
        empty = photograph
    blueness = empty[2] / np.maximum(empty.sum(axis=0), 1e-6)
    background = np.median(empty[:, blueness >= np.median(blueness)], axis=1)
    return Exposure(np.maximum(gain, 0), np.maximum(background, 0), max(float(np.percentile(photograph, WHITE_PERCENTILE)), 1e-6))


def hair_brightness(photographs: list[np.ndarray]) -> float:
    """Median light of what is redder than blue in photographs (3, H, W), linear, white 1; 0.1 where nothing is."""
    red, blue = (np.concatenate([photograph[k].ravel() for photograph in photographs]) for k in (0, 2))
    return float(np.median(red[red > blue])) if (red > blue).any() else 0.1


def resized(planes: np.ndarray, width: int, height: int) -> np.ndarray:
    """Planes (C, H, W) float32 at another size (C, height, width); each pixel is the mean of what it covers."""
    from PIL import Image

    return np.stack([np.asarray(Image.fromarray(plane.astype(np.float32)).resize((width, height), Image.Resampling.BOX)) for plane in planes])


def write_pairs(pairs: list[tuple[np.ndarray, np.ndarray]], captions: list[tuple[str, str]], out: Path) -> None:
    """Write a picture of all pairs (photograph, rendering), each (H, W, 3) uint8, with their captions below; atomically."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = pairs[0][0].shape[:2]
    across = max(1, math.ceil(math.sqrt(len(pairs) * height / (2 * width))))
    rows = -(-len(pairs) // across)
    cell_w, cell_h = 2 * (width + GAP_PX) + 3 * GAP_PX, height + CAPTION_PX + GAP_PX
    picture = Image.new("RGB", (across * cell_w - 4 * GAP_PX, rows * cell_h), PAPER)
    font = ImageFont.load_default(13)
    for i, (pair, texts) in enumerate(zip(pairs, captions, strict=True)):
        for k, (pixels, text) in enumerate(zip(pair, texts, strict=True)):
            x, y = (i % across) * cell_w + k * (width + GAP_PX), (i // across) * cell_h
            picture.paste(Image.fromarray(pixels), (x, y))
            caption = Image.new("RGB", (width, CAPTION_PX), PAPER)  # cut off where a picture is narrow
            ImageDraw.Draw(caption).text((5, 4), text, fill=INK, font=font)
            picture.paste(caption, (x, y + height))
    with atomic(out) as part:
        picture.save(part)


def write_grid(rows: list[list[np.ndarray]], captions: list[list[str]], out: Path) -> None:
    """Write rows of pictures, each (H, W, 3) uint8 and all of one size, with their captions below; atomically, with a palette of 256."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = rows[0][0].shape[:2]
    across, cell_h = max(len(row) for row in rows), height + CAPTION_PX + GAP_PX
    pictures = Image.new("RGB", (across * (width + GAP_PX) - GAP_PX, len(rows) * cell_h), PAPER)
    pen, font = ImageDraw.Draw(pictures), ImageFont.load_default(CAPTION_PX * 5 // 8)
    for i, (row, texts) in enumerate(zip(rows, captions, strict=True)):
        for k, (pixels, text) in enumerate(zip(row, texts, strict=True)):
            x, y = k * (width + GAP_PX), i * cell_h
            pictures.paste(Image.fromarray(pixels), (x, y))
            pen.text((x + 5, y + height + 3), text, fill=INK, font=font)
    with atomic(out) as part:
        pictures.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(part, optimize=True)


def write_png(pixels: np.ndarray, out: Path) -> None:
    """Write (H, W, 3) uint8 as a picture, atomically."""
    from PIL import Image

    with atomic(out) as part:
        Image.fromarray(pixels).save(part)


def read_png(path: Path) -> np.ndarray:
    """A picture as (H, W, 3) uint8."""
    from PIL import Image

    with Image.open(path) as opened:
        return np.array(opened.convert("RGB"))
