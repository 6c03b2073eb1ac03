"""A map as a picture, without a display and without a plotting library."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from tbmfg.timeseries import Floats

WIDTH = 1600
TALLEST = 4  # times as high as wide is a view at most
GAP = 20
FAINTEST = 0.5  # shade of a single point: what was seen once is to be seen
PATH = (230, 60, 40)


def picture(points: Floats, path: Floats) -> np.ndarray:
    """Plan and side view of a cloud (n, 3), one above the other, uint8 (h, w, 3): the denser the darker, blue low and
    green high. ``path`` (m, 3) is drawn into both. Lengths along are the longer horizontal axis of the cloud."""
    low, high = np.percentile(points, [0.1, 99.9], axis=0)
    low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    along = int(np.argmax((high - low)[:2]))
    across = 1 - along
    scale = (WIDTH - 1) / max(high[along] - low[along], (high - low).max() / TALLEST, 1e-6)
    shade = np.clip((points[:, 2] - low[2]) / max(high[2] - low[2], 1e-6), 0.0, 1.0)
    views = []
    for axis in (across, 2):
        height = max(2, int((high[axis] - low[axis]) * scale) + 1)
        views.append(_view(points, path, shade, (along, axis), low, scale, height))
        views.append(np.full((GAP, WIDTH, 3), 255, dtype=np.uint8))
    return np.vstack(views[:-1])


def _view(
    points: Floats, path: Floats, shade: Floats, axes: tuple[int, int], low: Floats, scale: float, height: int
) -> np.ndarray:
    def cells(values: Floats) -> tuple[np.ndarray, np.ndarray]:
        column, row = (((values[:, axis] - low[axis]) * scale).astype(int) for axis in axes)
        return height - 1 - row, column

    row, column = cells(points)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < WIDTH)
    flat = row[inside] * WIDTH + column[inside]
    count = np.bincount(flat, minlength=height * WIDTH)
    mean = np.bincount(flat, shade[inside], height * WIDTH) / np.maximum(count, 1)
    dark = np.log1p(count) / np.log1p(max(np.percentile(count[count > 0], 99), 1))
    dark = np.where(count > 0, np.clip(dark, FAINTEST, 1.0), 0.0)[:, None]
    colour = np.stack([np.full_like(mean, 30.0), 60 + 140 * mean, 200 - 140 * mean], axis=1)
    image = (255 + dark * (colour - 255)).reshape(height, WIDTH, 3)
    steps = np.linspace(0, len(path) - 1, 20 * WIDTH)
    fine = np.stack([np.interp(steps, np.arange(len(path)), path[:, a]) for a in range(3)], axis=1)
    row, column = cells(fine)
    image[row.clip(0, height - 1), column.clip(0, WIDTH - 1)] = PATH
    return image.astype(np.uint8)


def png(image: np.ndarray) -> bytes:
    """An image (h, w, 3) uint8 as PNG: W3C (2003), one zlib stream of unfiltered rows."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, _ = image.shape
    rows = np.hstack([np.zeros((height, 1), np.uint8), image.reshape(height, -1)])
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6))
        + chunk(b"IEND", b"")
    )
