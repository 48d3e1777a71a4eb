"""Reading and writing video with real time stamps.

Frames come upright (rotation flags applied) as RGB with their presentation time; nothing assumes a constant frame
rate. The whole file is scanned (without decoding) before the first frame is handed out, so that a truncated file is
one clear error at the start and not a short track at the end.
"""

from __future__ import annotations

import heapq
from collections.abc import Container, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, cast

import av
import cv2
import numpy as np
from av.video.frame import VideoFrame
from numpy.typing import NDArray

from .errors import UserError
from .files import atomic_path, sha256_of_file

Image = NDArray[np.uint8]

# A few broken packets are common at the start of clips cut from a longer recording; more means a damaged file.
MAX_BROKEN_FRACTION = 0.02
REORDER_DEPTH = 8
SEEK_ABOVE = 60  # frames from one to the next that is wanted, above which the video is entered at each
PIECE_FRAMES = 64  # held in memory at once when a clip is read backward
_SAME_S = 1e-7
_CLOCK_HZ = 90_000


@dataclass(frozen=True)
class VideoInfo:
    """What is known about a video file before decoding it.

    width_px, height_px: size of the upright image.  time_s: (N,) presentation times of the packets, from 0, sorted.
    rotation_deg: rotation flag already applied to the frames that `iterate_frames` yields.
    """

    path: Path
    width_px: int
    height_px: int
    time_s: NDArray[np.float64]
    rotation_deg: int
    sha256: str

    @property
    def frame_count(self) -> int:
        return len(self.time_s)

    @property
    def fps(self) -> float:
        """Median frame rate in Hz."""
        return float(1.0 / np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else 25.0

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1] - self.time_s[0]) + 1.0 / self.fps


@dataclass(frozen=True)
class Frame:
    """One upright frame: index in decoding order, presentation time in s from the first frame, (H, W, 3) RGB."""

    index: int
    time_s: float
    rgb: Image


def read_video_info(path: Path) -> VideoInfo:
    """Scan a video file.

    Raises UserError when it is missing, not a video, has no video stream or no frames, or is truncated.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"video {path} does not exist")
    if path.stat().st_size == 0:
        raise UserError(f"video {path} is empty (0 bytes)")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise UserError(f"{path} has no video stream (it holds {_stream_kinds(container)})")
            stream = container.streams.video[0]
            declared = int(stream.frames or 0)
            stamps = [
                packet.pts
                for packet in container.demux(stream)
                if packet.pts is not None and packet.size > 0 and not packet.is_corrupt
            ]
            time_base = float(stream.time_base or Fraction(1, _CLOCK_HZ))
        if not stamps:
            raise UserError(f"video {path} has a video stream but not one frame; record it again")
        if len(stamps) < declared * (1 - MAX_BROKEN_FRACTION):
            raise UserError(
                f"video {path} is truncated: {len(stamps)} of {declared} frames are there; copy it again or cut it "
                f"with `ffmpeg -i {path.name} -c copy repaired.mp4`"
            )
        first = next(_decode(path), None)
    except (av.FFmpegError, OSError) as error:
        raise UserError(f"{path} cannot be read as a video ({error.strerror or error}); is it complete?") from error
    if first is None:
        raise UserError(f"video {path}: none of its {len(stamps)} frames can be decoded; is it complete?")
    height_px, width_px = _upright(first).shape[:2]
    times = np.unique(np.asarray(stamps, float) * time_base)
    return VideoInfo(path, width_px, height_px, times - times[0], _rotation_deg(first), sha256_of_file(path))


def iterate_frames(
    path: Path, max_side_px: int | None = None, info: VideoInfo | None = None, wanted: Container[int] | None = None
) -> Iterator[Frame]:
    """Yield the frames of a video in presentation order, shrunk so that the longer side is at most `max_side_px`.

    info: from `read_video_info`, which is called when it is not given.  wanted: indices of the frames asked for, of
    all when None.
    Frames that cannot be decoded and frames whose time does not advance are left out. Raises UserError when more
    than MAX_BROKEN_FRACTION of the file's frames cannot be decoded.
    """
    info = info or read_video_info(path)
    count, last_s, start_s = 0, -np.inf, None
    for frame in _decode(info.path):
        time_s = float(frame.time or 0.0)
        start_s = time_s if start_s is None else start_s
        if time_s <= last_s:
            continue
        last_s = time_s
        if wanted is None or count in wanted:
            yield Frame(count, time_s - start_s, _shrunk(_upright(frame), max_side_px))
        count += 1
    if count < info.frame_count * (1 - MAX_BROKEN_FRACTION) - 1:
        raise UserError(f"video {path} is damaged: {count} of {info.frame_count} frames can be decoded; copy it again")


def iterate_backward(path: Path, time_s: Sequence[float], max_side_px: int | None = None) -> Iterator[Frame]:
    """Yield the first frames of a video from the last of them to the first, a piece at a time in memory.

    time_s: (N,) times of the first N frames, as `iterate_frames` gave them.
    Raises UserError when one of them cannot be decoded any more.
    """
    origin = next(_decode(path), None)
    start_s = 0.0 if origin is None else float(origin.time or 0.0)
    for end in range(len(time_s), 0, -PIECE_FRAMES):
        begin = max(0, end - PIECE_FRAMES)
        wanted = [start_s + t for t in time_s[begin:end]]
        # Not every file can be entered everywhere: what is missing then is read from the beginning.
        piece = _pick(_decode(path, wanted[0]), wanted, max_side_px)
        if len(piece) < len(wanted):
            piece = _pick(_decode(path), wanted, max_side_px)
        if len(piece) < len(wanted):
            raise UserError(f"video {path} changed while it was read, or cannot be decoded twice the same; copy it")
        for k in range(end - 1, begin - 1, -1):
            yield Frame(k, time_s[k], piece.pop(k - begin))


def sample_frames(info: VideoInfo, count: int, max_side_px: int | None = None) -> list[Frame]:
    """At most `count` frames spread evenly over a video, in order."""
    wanted = np.unique(np.linspace(0, info.frame_count - 1, count).round().astype(int))
    if info.frame_count <= SEEK_ABOVE * count:
        return list(iterate_frames(info.path, max_side_px, info, set(wanted.tolist())))
    # Reading a long video to its end takes minutes; entering it at a few places does not.
    origin = next(_decode(info.path), None)
    start_s = 0.0 if origin is None else float(origin.time or 0.0)
    frames = []
    for k in wanted:
        time_s = float(info.time_s[k])
        for rgb in _pick(_decode(info.path, start_s + time_s), [start_s + time_s], max_side_px).values():
            frames.append(Frame(int(k), time_s, rgb))
    return frames


class VideoWriter:
    """H.264 mp4 writer (yuv420p, so that every browser plays it); the file appears under its name when complete.

    Use as a context manager; `write(rgb)` at the constant rate, or `write(rgb, time_s)` with real time stamps.
    Odd image sizes lose their last row or column, since 4:2:0 chroma needs even sizes.
    preset: x264's; "ultrafast" takes 40 % of the time for files half as large again.
    """

    def __init__(self, path: Path, fps: float, crf: int = 20, preset: str = "veryfast") -> None:
        self._path, self._fps, self._crf, self._preset = Path(path), fps, crf, preset
        self._resources = ExitStack()
        self._container: Any = None
        self._stream: Any = None
        self._count = 0
        self._last_pts = -1

    def __enter__(self) -> VideoWriter:
        temporary = self._resources.enter_context(atomic_path(self._path))
        self._container = self._resources.enter_context(av.open(str(temporary), "w", options={"movflags": "faststart"}))
        return self

    def write(self, rgb: Image, time_s: float | None = None) -> None:
        """Append one (H, W, 3) uint8 RGB image."""
        height, width = rgb.shape[0] // 2 * 2, rgb.shape[1] // 2 * 2
        if self._stream is None:
            rate = Fraction(self._fps).limit_denominator(1001)
            # x264's macroblock tree reads memory it has not set on small pictures: without it, equal frames give
            # equal bytes, on which hashes of inputs rely.
            options = {"crf": str(self._crf), "preset": self._preset, "threads": "1", "mbtree": "0"}
            self._stream = self._container.add_stream("libx264", rate=rate, options=options)
            self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
            self._stream.codec_context.time_base = Fraction(1, _CLOCK_HZ)
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(rgb[:height, :width]), format="rgb24")
        seconds = self._count / self._fps if time_s is None else time_s
        frame.pts = self._last_pts = max(round(seconds * _CLOCK_HZ), self._last_pts + 1)
        frame.time_base = Fraction(1, _CLOCK_HZ)
        self._container.mux(self._stream.encode(frame))
        self._count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is None and self._stream is not None:
            self._container.mux(self._stream.encode(None))
        return self._resources.__exit__(kind, error, trace)


def _pick(frames: Iterator[VideoFrame], wanted_s: Sequence[float], max_side_px: int | None) -> dict[int, Image]:
    """The pictures of the frames with the times wanted (ascending), by place in `wanted_s`."""
    picked: dict[int, Image] = {}
    for frame in frames:
        time_s = float(frame.time or 0.0)
        if time_s > wanted_s[-1] + _SAME_S:
            break
        place = int(np.searchsorted(wanted_s, time_s - _SAME_S))
        if place < len(wanted_s) and abs(wanted_s[place] - time_s) <= _SAME_S and place not in picked:
            picked[place] = _shrunk(_upright(frame), max_side_px)
    return picked


def softened(rgb: Image) -> Image:
    """The picture without the noise of single pixels."""
    return np.asarray(cv2.GaussianBlur(rgb, (0, 0), 1.0), np.uint8)


def _shrunk(rgb: Image, max_side_px: int | None) -> Image:
    scale = 1.0 if max_side_px is None else max_side_px / max(rgb.shape[:2])
    if scale >= 1.0:
        return rgb
    size = (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _decode(path: Path, from_s: float | None = None) -> Iterator[VideoFrame]:
    """Frames by time; with `from_s`, from the last place before it where decoding can begin."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        if from_s is not None:
            container.seek(int(from_s / float(stream.time_base or Fraction(1, _CLOCK_HZ))), stream=stream)
        # Streams cut from a longer recording can announce too small a reorder depth, and FFmpeg then hands frames
        # out of order: a small heap puts them right.
        waiting: list[tuple[float, int, VideoFrame]] = []
        count = 0
        for packet in container.demux(stream):
            try:
                frames = cast(list[VideoFrame], packet.decode())
            except av.error.InvalidDataError:
                continue  # counted by the caller, who knows how many frames there should be
            for frame in frames:
                heapq.heappush(waiting, (float(frame.time or 0.0), count, frame))
                count += 1
            while len(waiting) > REORDER_DEPTH:
                yield heapq.heappop(waiting)[2]
        while waiting:
            yield heapq.heappop(waiting)[2]


def _rotation_deg(frame: VideoFrame) -> int:
    return round(float(getattr(frame, "rotation", 0) or 0) / 90) * 90 % 360


def _upright(frame: VideoFrame) -> Image:
    # FFmpeg's display matrix gives the counter-clockwise turn that makes the picture upright.
    rgb = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(rgb, _rotation_deg(frame) // 90))


def _stream_kinds(container: Any) -> str:
    kinds = sorted({str(stream.type) for stream in container.streams})
    return ", ".join(kinds) if kinds else "no streams at all"
