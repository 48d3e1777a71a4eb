"""Frames of one camera to an mp4 in memory, with the exact pixel statistics on the way."""

from __future__ import annotations

import io
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .episode import CameraVideo

# Every second frame is a key frame and none refers to a later one: policies read single frames at random, and
# files without reordering can be joined without touching their time stamps. One thread and no macroblock tree, which
# reads memory it has not set on small pictures: the same bytes every time.
ENCODER = {"vcodec": "h264", "pix_fmt": "yuv420p", "g": 2, "crf": 23, "preset": "veryfast"}
ENCODER_EXTRA = {"bf": 0, "mbtree": 0}


class CameraEncoder:
    """Encodes (H, W, 3) uint8 frames as h264 at a constant rate.

    The pixel histogram is taken over all frames before encoding: 256 bins are exact for bytes, and cheaper than
    the adaptive bins a general statistics tracker needs.
    """

    def __init__(self, fps: int) -> None:
        self._fps = fps
        self._buffer = io.BytesIO()
        self._container: Any = None
        self._stream: Any = None
        self._shape = (0, 0)
        self._count = 0
        self._histogram = np.zeros((3, 256), np.int64)

    def write(self, rgb: NDArray[np.uint8]) -> None:
        import av

        if self._container is None:
            self._shape = (rgb.shape[0], rgb.shape[1])
            self._container = av.open(self._buffer, "w", format="mp4")
            options = {key: str(value) for key, value in ENCODER.items() if key in ("g", "crf", "preset")}
            options |= {key: str(value) for key, value in ENCODER_EXTRA.items()} | {"threads": "1"}
            self._stream = self._container.add_stream("h264", rate=self._fps, options=options)
            self._stream.width, self._stream.height = rgb.shape[1], rgb.shape[0]
            self._stream.pix_fmt = ENCODER["pix_fmt"]
            self._stream.time_base = Fraction(1, self._fps)
        if rgb.shape != (*self._shape, 3) or rgb.dtype != np.uint8:
            raise ValueError(f"expected a uint8 frame of shape {(*self._shape, 3)}, got {rgb.dtype} {rgb.shape}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        frame.pts = self._count
        frame.time_base = Fraction(1, self._fps)
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
        for channel in range(3):
            self._histogram[channel] += np.bincount(rgb[..., channel].ravel(), minlength=256)
        self._count += 1

    def finish(self) -> CameraVideo:
        """Close the file and return it; the encoder cannot be used afterwards."""
        if self._container is None:
            raise ValueError("no frame was written")
        for packet in self._stream.encode():
            self._container.mux(packet)
        self._container.close()
        return CameraVideo(self._buffer.getvalue(), self._count, self._shape, self._histogram)


def histogram_statistics(histogram: NDArray[np.int64], frame_count: int) -> dict[str, NDArray[np.float64]]:
    """Statistics of pixel values in 0..255 per channel as LeRobot names them: min, max, mean, std, q01 to q99, count.

    histogram: (3, 256). Each value is (3,), `count` is (1,): the number of frames.
    """
    values = np.arange(256.0)
    total = histogram.sum(axis=1)
    mean = histogram @ values / total
    std = np.sqrt(np.maximum(histogram @ values**2 / total - mean**2, 0.0))
    present = histogram > 0
    cumulative = np.cumsum(histogram, axis=1)
    statistics = {
        "min": present.argmax(axis=1).astype(float),
        "max": 255.0 - present[:, ::-1].argmax(axis=1),
        "mean": mean,
        "std": std,
        "count": np.array([frame_count]),
    }
    for percent in (1, 10, 50, 90, 99):
        reached = cumulative >= (total * percent / 100)[:, None]
        statistics[f"q{percent:02d}"] = reached.argmax(axis=1).astype(float)
    return statistics
